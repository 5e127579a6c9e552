"""Stage 1: train the generalizable encoder on captures, through the marcher (paper sec. 3.2). `primdiffusion fit`."""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Callable, Iterator

import torch
from accelerate import Accelerator
from accelerate.utils import set_seed
from torch import Tensor, nn
from tqdm import tqdm

from primdiffusion import __version__
from primdiffusion.capture.dataset import Position, Share, batches
from primdiffusion.capture.reader import Captures, open_captures
from primdiffusion.encoder.config import PRESETS
from primdiffusion.encoder.encode import EncoderModel
from primdiffusion.encoder.network import Encoder
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import MarchSettings, Rendering, march
from primdiffusion.training.config import check_resumable, to_json, write_atomically
from primdiffusion.training.encoder_checkpoint import save_encoder
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_data import FitSample, fit_dataset
from primdiffusion.training.fit_losses import Features, loss_terms
from primdiffusion.training.fit_pictures import measure, write_pictures
from primdiffusion.training.fit_state import FitState, versions
from primdiffusion.training.interrupt import Interrupt

log = logging.getLogger(__name__)

STATE, MODEL, CONFIG, METRICS, RUN = (
    "state.safetensors",
    "encoder.safetensors",
    "config.json",
    "metrics.jsonl",
    "run.json",
)
"""Files of a run's folder; beside them pictures/."""


@dataclasses.dataclass(frozen=True)
class Progress:
    """One optimiser step."""

    step: int
    terms: dict[str, float]
    """The objective's terms, weighted."""
    gradient: float
    """Norm, before clipping."""
    seconds: dict[str, float]
    """data, forward, march, backward, update."""


def fit(config: FitConfig, perceptual: Features | None = None) -> EncoderModel:
    """Run or resume a run; returns the encoder as far as it got, which is also in run/encoder.safetensors.

    Under `accelerate launch` each process trains on its own batches, and gradients are averaged.

    Raises:
        ValueError: settings that cannot be, or others than those with which the run in this folder began; memory of the
            graphics card that does not suffice (says which batch to try).
        FileNotFoundError, CaptureFileError, NpzError, BodyFileError: captures are missing or damaged.
        FloatingPointError: the objective or its gradient is not finite.
        OSError: there is no room; the last whole state remains.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    accelerator = Accelerator(mixed_precision=config.mixed_precision, cpu=not torch.cuda.is_available())
    if isinstance(perceptual, nn.Module):
        perceptual.to(accelerator.device)
    captures = open_captures(config.data)
    held = None if config.held is None else open_captures(config.held)
    if accelerator.is_main_process:
        _begin(config, captures)
    accelerator.wait_for_everyone()
    set_seed(config.seed)
    state = FitState(Encoder(PRESETS[config.encoder]), config, accelerator)
    if (config.run / STATE).exists():
        state.load(config.run / STATE)
    record = _Recorder(config, captures, held, state)
    saved = began = time.monotonic()
    before = state.seconds
    with Interrupt(config.minutes) as interrupt:
        for progress in steps(config, state, captures, perceptual):
            state.seconds = before + time.monotonic() - began
            stop = _agreed(accelerator, interrupt.due()) or progress.step >= config.steps
            if accelerator.is_main_process:
                record(progress)
                if stop or time.monotonic() - saved > config.save_every:
                    state.save(config.run / STATE)
                    save_encoder(config.run / MODEL, model_of(config, state, captures))
                    saved = time.monotonic()
            if stop:
                break
    accelerator.wait_for_everyone()
    return model_of(config, state, captures)


def steps(
    config: FitConfig, state: FitState, captures: Captures, perceptual: Features | None = None
) -> Iterator[Progress]:
    """Optimiser steps from where the state is to `config.steps`; the caller owns progress, saving and stopping."""
    accelerator = state.accelerator
    share = Share(accelerator.process_index, accelerator.num_processes)
    start = Position(*json.loads(state.place.get("position", "[0, 0]")))
    source = batches(fit_dataset(captures, config), config.batch, start, config.workers, share)
    settings = MarchSettings(step=config.step)
    while state.step < config.steps:
        clock = _Clock(accelerator.device)
        sample, position = next(source)
        sample = sample.to(accelerator.device)
        clock.lap("data")
        try:
            terms = objective(config, state, sample, settings, clock, perceptual)
            total = torch.stack(list(terms.values())).sum()
            if not torch.isfinite(total):
                bad = ", ".join(name for name, value in terms.items() if not torch.isfinite(value))
                raise FloatingPointError(
                    f"{bad} at step {state.step} is not finite: lower the learning rate and resume"
                )
            gradient = state.update(total)
        except torch.cuda.OutOfMemoryError as error:
            smaller = max(config.batch // 2, 1)
            raise ValueError(
                f"the graphics card's memory does not hold {config.batch} people with {config.targets} targets of "
                f"{config.size} pixels each: try --batch {smaller} or fewer targets, in a new run folder"
            ) from error
        clock.lap("backward")
        state.place["position"] = json.dumps(list(position))
        yield Progress(
            state.step, {name: float(value.detach()) for name, value in terms.items()}, gradient, clock.seconds
        )


def objective(
    config: FitConfig,
    state: FitState,
    sample: FitSample,
    settings: MarchSettings,
    clock: _Clock,
    perceptual: Features | None = None,
) -> dict[str, Tensor]:
    """The weighted terms of one batch."""
    with state.accelerator.autocast():
        payload = state.prepared(sample.found, sample.axis_angle)
    payload = payload.to(dtype=torch.float32)
    if state.step < config.hold_scale:
        # Times zero and not left out: distributed training wants a gradient of every parameter.
        payload = dataclasses.replace(payload, delta_scale=1 + 0 * payload.delta_scale)
    clock.lap("forward")
    primitives = Primitives.place(sample.frames, payload)
    picture = drawn(primitives, sample, settings)
    target = sample.target.image.float() / 255
    mask = sample.target.mask.float() / 255
    image = encode_srgb(picture.rgb)
    terms = loss_terms(image, picture.alpha, primitives.half_extent, target, mask, config.loss, perceptual)
    clock.lap("march")
    return terms


def drawn(primitives: Primitives, sample: FitSample, settings: MarchSettings) -> Rendering:
    """Pictures [b, v] of people [b]."""
    return march(primitives.map(lambda tensor: tensor[:, None]), sample.target.camera, settings)


def model_of(config: FitConfig, state: FitState, captures: Captures) -> EncoderModel:
    """The averaged weights with their card."""
    card = {
        "name": f"PrimDiffusion encoder, {config.encoder}",
        "version": __version__,
        "licence": "CC0-1.0",
        "encoder": config.encoder,
        "people": len(captures.subjects),
        "captures": dict(captures.about),
        "steps": state.step,
        "batch": config.batch * state.accelerator.num_processes,
        "seconds": round(state.seconds, 1),
        "device": str(state.accelerator.device),
        "seed": config.seed,
        "loss": json.loads(json.dumps(dataclasses.asdict(config.loss), default=str)),
        "full_density": PRESETS[config.encoder].full_density,
        **versions(),
    }
    card["captures"].pop("part_names", None)
    return EncoderModel(state.encoder, card)


def _begin(config: FitConfig, captures: Captures) -> None:
    """The run's folder: settings, versions and what it is trained on, or the proof that they are as before."""
    saved = config.run / CONFIG
    if saved.exists():
        check_resumable(saved.read_text(), config)
        _cut_metrics(config)
    write_atomically(saved, to_json(config))
    about = {"version": __version__, **versions(), "people": list(captures.subjects)}
    write_atomically(config.run / RUN, json.dumps(about, indent=1))


def _cut_metrics(config: FitConfig) -> None:
    """Lines behind the saved state belong to steps that a kill undid; they will be written again."""
    path = config.run / METRICS
    if path.exists():
        step = FitState.saved_step(config.run / STATE)
        lines = [line for line in path.read_text().splitlines() if _step_of(line) <= step]
        write_atomically(path, "".join(line + "\n" for line in lines))


def _step_of(line: str) -> float:
    try:
        return json.loads(line)["step"]
    except (ValueError, KeyError, TypeError):
        return float("inf")


def _agreed(accelerator: Accelerator, stop: bool) -> bool:
    """Whether any process wants to stop: all must leave the loop after the same step."""
    if accelerator.num_processes == 1:
        return stop
    wishes = accelerator.gather(torch.tensor([stop], device=accelerator.device))
    return bool(torch.as_tensor(wishes).any())


class _Clock:
    """Seconds between laps, with the device's work waited for."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.seconds = device, {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


class _Recorder:
    """metrics.jsonl, pictures and the bar; of the main process."""

    def __init__(self, config: FitConfig, captures: Captures, held: Captures | None, state: FitState) -> None:
        self.config, self.captures, self.held, self.state = config, captures, held, state
        self.bar = tqdm(total=config.steps, initial=state.step, unit="step", disable=None)
        self.mean: dict[str, float] = {}

    def __call__(self, progress: Progress) -> None:
        row = {**progress.terms, "gradient": progress.gradient}
        row |= {f"seconds_{name}": value for name, value in progress.seconds.items()}
        for name, value in row.items():
            before = self.mean.get(name, value)
            self.mean[name] = before + (value - before) * 0.04
        self.bar.update()
        if self._due(progress.step, self.config.log_every):
            self._write({"step": progress.step, "seconds": self.state.seconds, **self.mean})
        if self._due(progress.step, self.config.evaluate_every):
            self._measure(progress.step)
        if self._due(progress.step, self.config.pictures_every):
            path = self.config.run / "pictures" / f"{progress.step:07d}.png"
            write_pictures(path, self._model(), self.held or self.captures)

    def _due(self, step: int, every: int) -> bool:
        return step % every == 0 or step == self.config.steps

    def _model(self) -> EncoderModel:
        return EncoderModel(self.state.encoder, {})

    def _measure(self, step: int) -> None:
        sets: dict[str, Callable[[], float]] = {"psnr_train": lambda: measure(self._model(), self.captures)}
        if self.held is not None:
            held = self.held
            sets["psnr_held"] = lambda: measure(self._model(), held)
        self._write({"step": step, "seconds": self.state.seconds, **{name: find() for name, find in sets.items()}})

    def _write(self, row: dict[str, float]) -> None:
        log.info(" ".join(f"{name}={value:.4g}" for name, value in row.items()))
        with (self.config.run / METRICS).open("a") as file:
            file.write(json.dumps(row) + "\n")
