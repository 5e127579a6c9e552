"""The loop in which every network is trained: steps, metrics, pictures, saved states, and a stop between two steps.

    state = train(task, config, accelerator)        # resumes from the state in the run's folder

A task gives a network, its loss, held-out errors and pictures: `fit.EncoderTask`, `cells.CellTask`,
`diffusion_task.SlabTask`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import math
import os
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType

import torch
from accelerate import Accelerator
from torch import Tensor, nn
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from primdiffusion.files.json_files import parse_message
from primdiffusion.runtime.failures import out_of_memory
from primdiffusion.training.config import OptimiserSettings, RunSettings
from primdiffusion.training.run_folder import PICTURES, STATE, Metrics, open_metrics
from primdiffusion.training.state import TrainingState, adamw, any_process_stops

log = logging.getLogger(__name__)

SMOOTHING_STEPS = 25
"""Approximate window of the running means in metrics.jsonl, steps."""
FORCE_QUIT_AFTER_S = 2.0
"""Seconds after the first Ctrl-C before a second one stops at once: launchers forward the first one twice."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclasses.dataclass(frozen=True)
class TrainingStep:
    """One optimiser step, as its loss sees it."""

    number: int
    """Completed steps."""
    generator: torch.Generator
    """Random numbers on the device that depend on seed, step and process only, as torch's own do in a step."""
    place: dict[str, str]
    """State of the task, saved and restored with the network."""


@dataclasses.dataclass(frozen=True)
class StepMetrics:
    """Metrics of one optimiser step."""

    terms: Mapping[str, float]
    """Weighted terms of the objective on the batch of this process."""
    gradient: float
    """Norm of the gradient before clipping."""
    seconds: float


class Task(ABC):
    """Training of one network."""

    name: str
    """Name of the network, before its settings on the command line; "" where they stand alone."""
    smaller: str
    """Advice for a batch of 1 that does not fit into memory."""

    @property
    @abstractmethod
    def settings(self) -> OptimiserSettings:
        """Return the settings of the network's training."""

    @abstractmethod
    def network(self) -> nn.Module:
        """Return the network as initialised."""

    @abstractmethod
    def use_network(self, network: nn.Module) -> None:
        """Use this network from now on: the one in training, or its average."""

    def optimiser(self, network: nn.Module) -> torch.optim.Optimizer:
        """Return the optimiser; the "factor" of a parameter group multiplies the learning rate."""
        return adamw(self.settings, network.parameters())

    @abstractmethod
    def loss(self, step: TrainingStep) -> Mapping[str, Tensor]:
        """Return the weighted terms of the objective on a random batch."""

    @abstractmethod
    def held_out(self) -> Mapping[str, float]:
        """Evaluate the network in use."""

    @abstractmethod
    def draw(self, path: Path) -> None:
        """Write a picture of what the network in use makes. Raises OSError."""

    @abstractmethod
    def save(self, state: TrainingState) -> None:
        """Write what belongs to a state that is about to be saved."""


def train(task: Task, config: RunSettings, accelerator: Accelerator) -> TrainingState:
    """Train or resume the network of a task until its last step or an interrupt; returns its state.

    The average is in use afterwards. The state is saved at intervals and at the end. Ctrl-C, SIGTERM and the time limit
    end a run between two steps.

    Raises:
        ValueError: loss, gradient or weights are not finite; out of memory; a saved state is damaged
            or of another network.
        OSError: the disk is full; the last saved state remains.
    """
    recorded = open_metrics(config) if accelerator.is_main_process else contextlib.nullcontext()
    with Interrupt(config.minutes) as interrupt, logging_redirect_tqdm(), recorded as metrics:
        return _train(task, config, accelerator, interrupt, metrics)


def _train(
    task: Task, config: RunSettings, accelerator: Accelerator, interrupt: Interrupt, metrics: Metrics | None
) -> TrainingState:
    path, steps = config.run / STATE, task.settings.steps
    state = begin_training(task, accelerator)
    if path.exists():
        state.load(path)
    saved, seconds = state.step, state.seconds
    began = last = time.monotonic()
    with Recorder(task, config, state, metrics) if metrics else contextlib.nullcontext() as recorder:
        while state.step < steps and not any_process_stops(accelerator, interrupt.due()):
            progress = take_step(task, config.seed, state)
            state.seconds = seconds + time.monotonic() - began
            if recorder is None:
                continue
            recorder(progress)
            if time.monotonic() - last >= config.save_every:
                _save(task, state, path)
                saved, last = state.step, time.monotonic()
        if recorder is not None and state.step > saved:
            _save(task, state, path)
    accelerator.wait_for_everyone()
    task.use_network(state.average)
    return state


def begin_training(task: Task, accelerator: Accelerator) -> TrainingState:
    """Return the state of the network before its first step, and use the network. Raises ValueError: out of memory."""
    with _memory_named(task):
        network = task.network().requires_grad_(True).to(accelerator.device)
        state = TrainingState(network, task.settings, accelerator, task.optimiser(network))
    task.use_network(state.prepared)
    return state


def take_step(task: Task, seed: int, state: TrainingState) -> StepMetrics:
    """Take one optimiser step; its random numbers depend only on seed, name, step and process.

    Raises ValueError: the loss or its gradient is not finite; out of memory.
    """
    device = state.accelerator.device
    seed = step_seed(seed, task.name, state.step, state.accelerator.process_index)
    torch.manual_seed(seed)
    generator, began = torch.Generator(device).manual_seed(seed), time.perf_counter()
    state.prepared.train()
    with _memory_named(task):
        terms = task.loss(TrainingStep(state.step, generator, state.place))
        values = {name: float(term.detach()) for name, term in terms.items()}
        if bad := [name for name, value in values.items() if not math.isfinite(value)]:
            raise ValueError(
                f"the loss ({', '.join(bad)}) at step {state.step} is not finite: lower "
                f"{_option(task, 'learning-rate')} in a new run folder"
            )
        gradient = state.update(torch.stack(list(terms.values())).sum())
    return StepMetrics(values, gradient, time.perf_counter() - began)


def step_seed(seed: int, name: str, step: int, process: int) -> int:
    """The seed of one step's random numbers on one process, 0 ... 2^63 - 1; `name` is the network's."""
    digest = hashlib.sha256(f"{seed}/{name}/{step}/{process}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def _save(task: Task, state: TrainingState, path: Path) -> None:
    task.save(state)
    state.save(path)


def _option(task: Task, name: str) -> str:
    return f"--{task.name}.{name}" if task.name else f"--{name}"


@contextlib.contextmanager
def _memory_named(task: Task) -> Iterator[None]:
    """Turn out-of-memory errors into a ValueError that says what to try."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not out_of_memory(error):
            raise
        batch = task.settings.batch
        remedy = f"{_option(task, 'batch')} {batch // 2}" if batch > 1 else task.smaller
        raise ValueError(f"out of memory for a batch of {batch}: try {remedy} in a new run folder") from error


class Recorder:
    """Writes metrics and pictures of a run and shows a progress bar, in the main process.

    Running means are saved in the state, so that a resumed run writes the same lines as an uninterrupted one.
    """

    def __init__(self, task: Task, config: RunSettings, state: TrainingState, metrics: Metrics) -> None:
        self.task, self.config, self.state, self.metrics = task, config, state, metrics
        self.means: dict[str, float] = parse_message(state.place.get("means", "{}"))

    def __enter__(self) -> Recorder:
        self.bar = tqdm(total=self.task.settings.steps, initial=self.state.step, unit="step", disable=None)
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.close()

    def __call__(self, progress: StepMetrics) -> None:
        """Record a step. Raises OSError if the disk is full."""
        step = self.state.step
        row = {**progress.terms, "gradient": progress.gradient, "seconds_step": progress.seconds}
        for name, value in row.items():
            before = self.means.get(name, value)
            self.means[name] = before + (value - before) / min(step, SMOOTHING_STEPS)
        self.state.place["means"] = json.dumps(self.means)
        self.bar.update()
        if self._due(self.config.log_every):
            self._write(self.means)
        if self._due(self.task.settings.evaluate_every):
            with self._averaged():
                self._write(self.task.held_out())
        if self._due(self.config.pictures_every):
            with self._averaged():
                self.task.draw(self.config.run / PICTURES / f"{step:07d}.png")

    def _due(self, every: int) -> bool:
        return self.state.step % every == 0 or self.state.step == self.task.settings.steps

    @contextlib.contextmanager
    def _averaged(self) -> Iterator[None]:
        self.task.use_network(self.state.average)
        try:
            yield
        finally:
            self.task.use_network(self.state.prepared)

    def _write(self, values: Mapping[str, float]) -> None:
        step, steps = self.state.step, self.task.settings.steps
        left = (steps - step) * self.means["seconds_step"]
        shown = " ".join(f"{name}={value:.4g}" for name, value in values.items())
        log.info("step %d of %d, %s left: %s", step, steps, tqdm.format_interval(left), shown)
        self.metrics.append({"step": step, "seconds": self.state.seconds, **values})


class Interrupt:
    """Stops loops after the current step: at a deadline, on SIGINT (Ctrl-C) or SIGTERM, so that no step is cut short.

    A second Ctrl-C, FORCE_QUIT_AFTER_S seconds later, raises KeyboardInterrupt wherever the loop is.
    """

    def __init__(self, minutes: float | None):
        self.deadline = time.monotonic() + 60 * minutes if minutes is not None else float("inf")
        self.pressed = False
        self._at = 0.0
        self._process = os.getpid()
        self._before = {}

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._press) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _press(self, number: int, _frame: FrameType | None) -> None:
        if os.getpid() != self._process:
            return  # a loader's worker, which inherited this handler; its parent ends it
        if not self.pressed:
            log.info("stopping after this step")
            self.pressed, self._at = True, time.monotonic()
        elif number == signal.SIGINT and time.monotonic() - self._at > FORCE_QUIT_AFTER_S:
            raise KeyboardInterrupt

    def due(self) -> bool:
        """Return whether to stop now."""
        return self.pressed or time.monotonic() > self.deadline
