"""Stage 1: train the generalizable encoder on captures, through the marcher (paper sec. 3.2). `primdiffusion fit`."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import time
from collections.abc import Iterator, Sequence

import torch
import tyro
from accelerate import PartialState
from accelerate.utils import set_seed
from torch import Tensor
from tqdm.contrib.logging import logging_redirect_tqdm

from primdiffusion import __version__
from primdiffusion.capture.dataset import Position, ProcessRank
from primdiffusion.capture.reader import Captures, open_captures
from primdiffusion.encoder.config import PRESETS
from primdiffusion.encoder.model import EncoderModel
from primdiffusion.encoder.network import Encoder
from primdiffusion.failures import out_of_memory
from primdiffusion.formats.json_files import parse_json
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import MarchSettings, Rendering, march
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_data import FitDataset, FitSample, betas_of, fit_batches, fit_dataset
from primdiffusion.training.fit_losses import Features, load_perceptual, loss_terms
from primdiffusion.training.fit_run import MODEL, STATE, FitRecorder, FitState, begin, save
from primdiffusion.training.recorder import Interrupt, StepMetrics, StepTimer
from primdiffusion.training.run_folder import alone, versions
from primdiffusion.training.state import NotFiniteError, accelerator_of, agreed
from primdiffusion.training.trackers import check_tracker, tracking


def run(arguments: Sequence[str]) -> None:
    """Run a command line, also by `accelerate launch -m primdiffusion fit`, and print the path of the encoder."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    config = tyro.cli(FitConfig, args=arguments, prog="primdiffusion fit")
    model = fit(config)
    if PartialState().is_main_process:
        print(f"{config.run / MODEL}  {model.card['steps']} of {config.steps} steps")


@alone
def fit(config: FitConfig) -> EncoderModel:
    """Start or resume a run; returns the encoder, which is also saved as run/encoder.safetensors.

    Under `accelerate launch` each process trains on its own batches, and gradients are averaged. Ctrl-C or SIGTERM
    stops after the current step and saves.

    Raises:
        ValueError: settings that cannot be, or others than those with which the run in this folder began; captures
            without a frame, or of another body; objective or gradient that are not finite (NotFiniteError); too little
            memory (says which batch to try).
        FileNotFoundError, CaptureFileError, ArrayFileError, BodyFileError, WeightsFileError: files are missing or
            damaged.
        OSError: there is no room; the last whole state remains.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    check_tracker(config.tracker)
    accelerator = accelerator_of(config.mixed_precision)
    perceptual = _features(config, accelerator.device)
    captures = open_captures(config.data)
    held = None if config.held is None else open_captures(config.held)
    if held is not None:
        betas_of(held)
    dataset = fit_dataset(captures, config)
    if not len(dataset):
        raise ValueError(f"the captures in {config.data} have no frames: render some")
    if accelerator.is_main_process:
        begin(config, captures, accelerator.num_processes)
    accelerator.wait_for_everyone()
    set_seed(config.seed)
    with _memory_named(config):
        state = FitState(Encoder(PRESETS[config.encoder]), config, accelerator)
        if (config.run / STATE).exists():
            state.load(config.run / STATE)
    with tracking(config.tracker if accelerator.is_main_process else None, config.run) as tracker:
        recorder = FitRecorder(config, captures, held, state, tracker) if accelerator.is_main_process else None
        _run(config, state, dataset, recorder, perceptual)
    accelerator.end_training()
    return model_of(config, state, captures)


def _run(
    config: FitConfig, state: FitState, dataset: FitDataset, recorder: FitRecorder | None, perceptual: Features | None
) -> None:
    """Steps until the last one or an interrupt, saved now and then."""
    captures = dataset.samples.captures
    saved = began = time.monotonic()
    before = state.seconds
    with contextlib.ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt(config.minutes))
        if recorder is not None:
            stack.enter_context(logging_redirect_tqdm())
            stack.enter_context(recorder)
        for progress in steps(config, state, dataset, perceptual):
            state.seconds = before + time.monotonic() - began
            if recorder is not None:
                recorder(progress)
            stop = agreed(state.accelerator, interrupt.due()) or progress.step >= config.steps
            if recorder is not None and (stop or time.monotonic() - saved > config.save_every):
                save(config, state, model_of(config, state, captures))
                saved = time.monotonic()
            if stop:
                break
    state.accelerator.wait_for_everyone()


def steps(
    config: FitConfig, state: FitState, dataset: FitDataset, perceptual: Features | None = None
) -> Iterator[StepMetrics]:
    """Optimiser steps from where the state is to `config.steps`; the caller owns progress, saving and stopping."""
    accelerator = state.accelerator
    share = ProcessRank(accelerator.process_index, accelerator.num_processes)
    start = Position(*parse_json(state.place.get("position", "[0, 0]")))
    source = fit_batches(dataset, config, start, share)
    settings = MarchSettings(step=config.step)
    while state.step < config.steps:
        clock = StepTimer(accelerator.device)
        sample, position = next(source)
        with _memory_named(config):
            sample = sample.to(accelerator.device)
            clock.lap("data")
            terms = objective(config, state, sample, settings, clock, perceptual)
            gradient = state.update(_total(terms, state.step))
        clock.lap("backward")
        state.place["position"] = json.dumps(list(position))
        values = {name: float(value.detach()) for name, value in terms.items()}
        yield StepMetrics(state.step, values, gradient, clock.seconds)


def objective(
    config: FitConfig,
    state: FitState,
    sample: FitSample,
    settings: MarchSettings,
    clock: StepTimer,
    perceptual: Features | None = None,
) -> dict[str, Tensor]:
    """The weighted terms of one batch."""
    with state.accelerator.autocast():
        payload = state.prepared(sample.found, sample.axis_angle)
    payload = payload.to(dtype=torch.float32)
    if state.step < config.hold_scale:
        # Multiplied by zero, because distributed training needs a gradient of every parameter.
        start = payload.delta_scale.new_tensor(PRESETS[config.encoder].extent)
        payload = dataclasses.replace(payload, delta_scale=start + 0 * payload.delta_scale)
    clock.lap("forward")
    primitives = Primitives.place(sample.frames, payload)
    picture = render_targets(primitives, sample, settings)
    target = sample.target.image.float() / 255
    mask = sample.target.mask.float() / 255
    image = encode_srgb(picture.rgb)
    terms = loss_terms(image, picture.alpha, primitives.half_extent, target, mask, config.loss, perceptual)
    clock.lap("march")
    return terms


def _total(terms: dict[str, Tensor], step: int) -> Tensor:
    total = torch.stack(list(terms.values())).sum()
    if not torch.isfinite(total):
        bad = ", ".join(name for name, value in terms.items() if not torch.isfinite(value))
        raise NotFiniteError(
            f"the loss ({bad}) at step {step} is not finite: lower the learning rate in a new run folder"
        )
    return total


def render_targets(primitives: Primitives, sample: FitSample, settings: MarchSettings) -> Rendering:
    """Render the target views [b, v] of humans [b]."""
    return march(primitives.map(lambda tensor: tensor[:, None]), sample.target.camera, settings)


def model_of(config: FitConfig, state: FitState, captures: Captures) -> EncoderModel:
    """The averaged weights with their card."""
    card = {
        "name": f"PrimDiffusion encoder, {config.encoder}",
        "version": __version__,
        "encoder": config.encoder,
        "people": len(captures.subjects),
        "captures": dict(captures.about),
        "views": config.views,
        "targets": config.targets,
        "size": config.size,
        "steps": state.step,
        "batch": config.batch * state.accelerator.num_processes,
        "seconds": round(state.seconds, 1),
        "device": str(state.accelerator.device),
        "seed": config.seed,
        "loss": parse_json(json.dumps(dataclasses.asdict(config.loss), default=str)),
        "full_density": PRESETS[config.encoder].full_density,
        **versions(),
    }
    card["captures"].pop("part_names", None)
    return EncoderModel(state.encoder, card)


def _features(config: FitConfig, device: torch.device) -> Features | None:
    path = config.loss.perceptual_weights
    return load_perceptual(path).to(device) if config.loss.perceptual and path is not None else None


@contextlib.contextmanager
def _memory_named(config: FitConfig) -> Iterator[None]:
    """ValueError that says what to try, where memory runs out."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not out_of_memory(error):
            raise
        remedy = f"--batch {config.batch // 2}" if config.batch > 1 else "fewer --targets, or a smaller --size"
        raise ValueError(
            f"{config.batch} subjects with {config.targets} targets of {config.size} x {config.size} pixels do not fit "
            f"into memory: try {remedy} in a new run folder"
        ) from error
