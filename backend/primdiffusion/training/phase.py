"""Train or resume one network of a diffusion model, for either preset, with images of samples as it goes."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from accelerate import Accelerator
from PIL import Image
from torch import Tensor, nn
from tqdm.contrib.logging import logging_redirect_tqdm

from primdiffusion.device import has_fast_bfloat16
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.failures import out_of_memory
from primdiffusion.formats import requests
from primdiffusion.formats.whole_files import written_whole
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.human import framing, generate_batch, place
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.training.config import PhaseConfig
from primdiffusion.training.muon import MuonAdamW
from primdiffusion.training.recorder import Interrupt, Recorder, StepMetrics, StepTimer
from primdiffusion.training.run_folder import PICTURES, append_metrics
from primdiffusion.training.state import AcceleratedState, NotFiniteError, agreed
from primdiffusion.training.trackers import RunTracker

SEEDS = (0, 1, 2, 3)
"""Of the samples in images."""
WIDTH, HEIGHT = 256, 256
YAW = 0.4
"""Radians."""
STEP = 0.006
"""Metres between samples of a ray."""


class PhaseRun(Protocol):
    """Settings that a phase takes from its run, as in `TrainingConfig`."""

    @property
    def run(self) -> Path: ...
    @property
    def seed(self) -> int: ...
    @property
    def save_every(self) -> float: ...
    @property
    def log_every(self) -> int: ...
    @property
    def pictures_every(self) -> int: ...


class Trainee(Protocol):
    """A model in training."""

    @property
    def phases(self) -> Mapping[str, PhaseConfig]:
        """Its networks by name, in the order in which they are trained."""
        ...

    def network(self, name: str) -> nn.Module:
        """One network, as initialised."""
        ...

    def put(self, name: str, network: nn.Module) -> None:
        """Install a network under this name: the trained one, or its average."""
        ...

    def loss(self, name: str, generator: torch.Generator) -> Tensor:
        """Loss of the named network on a random batch."""
        ...

    def errors(self) -> Mapping[int, float]:
        """Root mean square x0 error on held-out people, by level, of the installed networks."""
        ...

    def model(self) -> DiffusionModel:
        """Return the model with the installed networks, without a card."""
        ...


def train_phase(
    config: PhaseRun,
    trainee: Trainee,
    name: str,
    accelerator: Accelerator,
    interrupt: Interrupt,
    tracker: RunTracker | None = None,
) -> AcceleratedState:
    """Train one network until its last step or an interrupt, and install its average.

    Raises:
        ValueError: loss or gradient are not finite (NotFiniteError); out of memory; the saved state is damaged or of
            another network.
        OSError: the disk is full; the last saved state remains.
    """
    phase, path = trainee.phases[name], state_path(config, name)
    state = PhaseState(trainee.network(name).requires_grad_(True), phase, config.seed, accelerator)
    if path.exists():
        state.load(path)
    recorder = PhaseRecorder(config, trainee, name, state, tracker) if accelerator.is_main_process else None
    trainee.put(name, state.prepared)
    began = saved = time.monotonic()
    before, first = state.seconds, state.step
    with contextlib.ExitStack() as stack:
        if recorder is not None:
            stack.enter_context(logging_redirect_tqdm())
            stack.enter_context(recorder)
        while state.step < phase.steps and not agreed(accelerator, interrupt.due()):
            progress = step(config, trainee, name, state)
            state.seconds = before + time.monotonic() - began
            if recorder is not None:
                recorder(progress)
                if time.monotonic() - saved >= config.save_every:
                    state.save(path)
                    saved = time.monotonic()
    if recorder is not None and state.step > first:
        state.save(path)
    accelerator.wait_for_everyone()
    trainee.put(name, state.average)
    return state


class PhaseState(AcceleratedState):
    """State of a phase, with the optimiser of its settings."""

    config: PhaseConfig

    def _optimiser(self) -> torch.optim.Optimizer:
        fast = has_fast_bfloat16(next(self.network.parameters()).device)
        self._kind = "muon" if fast and self.config.optimiser == "muon" else "adamw"
        if self._kind == "muon":
            return MuonAdamW(self.network, self.config.learning_rate, self.config.weight_decay)
        return super()._optimiser()

    def save(self, path: Path) -> None:
        """Save as `TrainingState.save`, with the kind of optimiser."""
        self.place["optimiser"] = self._kind
        super().save(path)

    def load(self, path: Path) -> None:
        """Restore as `TrainingState.load`; ValueError also for the state of another optimiser."""
        super().load(path)
        before = self.place.get("optimiser", self._kind)
        if before != self._kind:
            raise ValueError(
                f"{path} was trained with {before}, but this device trains with {self._kind} (Muon needs "
                "bfloat16): resume on a device like the first, or begin a new run with --start-from"
            )


def step(config: PhaseRun, trainee: Trainee, name: str, state: AcceleratedState) -> StepMetrics:
    """Run one optimiser step; its random numbers depend only on seed, phase, step and process."""
    device, phase = state.accelerator.device, trainee.phases[name]
    seed = step_seed(config.seed, name, state.step, state.accelerator.process_index)
    torch.manual_seed(seed)
    clock = StepTimer(device)
    state.prepared.train()
    with _memory_named(name, phase):
        loss = trainee.loss(name, torch.Generator(device).manual_seed(seed))
        value = float(loss.detach())
        if not math.isfinite(value):
            raise NotFiniteError(
                f"the loss of {name!r} at step {state.step} is not finite: lower --{name}.learning-rate in a new run "
                "folder"
            )
        clock.lap("forward")
        gradient = state.update(loss)
    clock.lap("backward")
    return StepMetrics(state.step, {"loss": value}, gradient, clock.seconds)


def step_seed(seed: int, phase: str, step: int, process: int) -> int:
    """The seed of one step's random numbers on one process, 0 ... 2^63 - 1."""
    digest = hashlib.sha256(f"{seed}/{phase}/{step}/{process}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def state_path(config: PhaseRun, name: str) -> Path:
    """Path of the saved state of a phase."""
    return config.run / f"{name}.state.safetensors"


@dataclasses.dataclass(frozen=True)
class _Every:
    log_every: int
    evaluate_every: int
    pictures_every: int


class PhaseRecorder(Recorder):
    """Records a phase: held-out error, and people generated with the averaged weights."""

    def __init__(
        self,
        config: PhaseRun,
        trainee: Trainee,
        name: str,
        state: AcceleratedState,
        tracker: RunTracker | None = None,
    ) -> None:
        phase = trainee.phases[name]
        every = _Every(config.log_every, phase.evaluate_every, config.pictures_every)
        super().__init__(phase.steps, every, state, name)
        self.run, self.trainee, self.phase, self.prepared = config.run, trainee, name, state.prepared
        names = list(trainee.phases)
        self.tracker, self.before = tracker, sum(trainee.phases[one].steps for one in names[: names.index(name)])

    def measured(self) -> dict[str, float]:
        """RMS x0 error at each level."""
        with self._averaged():
            return {f"rms_{level}": error for level, error in self.trainee.errors().items()}

    def draw(self) -> None:
        """Render a few samples side by side."""
        with self._averaged():
            write_samples(self.run / PICTURES / f"{self.phase}_{self.state.step:07d}.png", self.trainee.model())

    def append(self, row: Mapping[str, float]) -> None:
        """Append a line to metrics.jsonl, with the phase."""
        line = {"phase": self.phase, **row}
        append_metrics(self.run, line)
        if self.tracker is not None:
            self.tracker.log(line, self.before + self.state.step)

    @contextlib.contextmanager
    def _averaged(self) -> Iterator[None]:
        self.trainee.put(self.phase, self.state.average)
        try:
            yield
        finally:
            self.trainee.put(self.phase, self.prepared)


@contextlib.contextmanager
def _memory_named(name: str, phase: PhaseConfig) -> Iterator[None]:
    """Turn out-of-memory errors into a ValueError that suggests a batch size."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not out_of_memory(error):
            raise
        remedy = f"--{name}.batch {phase.batch // 2}" if phase.batch > 1 else "a smaller network, or another device"
        raise ValueError(f"out of memory for a batch of {phase.batch}: try {remedy} in a new run folder") from error


@torch.no_grad()
def write_samples(
    path: Path, model: DiffusionModel, seeds: Sequence[int] = SEEDS, steps: int = requests.Sampling.steps
) -> None:
    """Write an image of humans of `seeds`, side by side over black. Raises OSError."""
    pictures = []
    for human in generate_batch(model, seeds, steps):
        primitives = place(human)
        camera = framing(primitives, YAW, WIDTH, HEIGHT).to(model.device)
        rendering = march(primitives.to(model.device), camera, MarchSettings(step=STEP))
        pictures.append(encode_srgb(rendering.rgb.clamp(0, 1)).cpu())
    picture = (torch.cat(pictures, dim=1) * 255).round().to(torch.uint8).numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        Image.fromarray(np.ascontiguousarray(picture)).save(unfinished, format="PNG")
