"""Stage 1: train the generalizable encoder on captures, through the marcher (paper sec. 3.2). `primdiffusion fit`."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import torch
import tyro
from accelerate import Accelerator, PartialState
from torch import Tensor, nn

from primdiffusion.capture.conditioning import default_betas
from primdiffusion.capture.dataset import CaptureDataset, Position, ProcessRank, SampleSettings
from primdiffusion.capture.reader import Captures, open_captures
from primdiffusion.encoder.blocks import UntiedConv
from primdiffusion.encoder.config import EncoderConfig
from primdiffusion.encoder.model import EncoderModel, load_encoder, save_encoder
from primdiffusion.encoder.network import Encoder
from primdiffusion.evaluation.metrics import psnr
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.picture_files import write_png
from primdiffusion.geometry.image import encode_srgb, to_bytes
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_data import Batch, FitSample, betas_of, fit_batches, fit_dataset
from primdiffusion.training.fit_losses import Features, load_perceptual, loss_terms
from primdiffusion.training.loop import Task, TrainingStep, train
from primdiffusion.training.run_folder import begin, open_run, versions
from primdiffusion.training.state import TrainingState, adamw
from primdiffusion.version import __version__

MODEL = "encoder.safetensors"
SIZE = 256
"""Width and height of the images that are evaluated and drawn, pixels."""
PEOPLE = 6
"""Number of subjects that are evaluated and drawn."""
SEED = 7
"""Seed of their frames and views."""


def run(arguments: Sequence[str]) -> None:
    """Run a command line, also by `accelerate launch -m primdiffusion fit`, and print the path of the encoder."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    config = tyro.cli(FitConfig, args=arguments, prog="primdiffusion fit")
    model = fit(config)
    if PartialState().is_main_process:
        print(f"{config.run / MODEL}  {model.card['steps']} of {config.steps} steps")


def fit(config: FitConfig) -> EncoderModel:
    """Start or resume a run; returns the encoder, which is also saved as run/encoder.safetensors.

    Under `accelerate launch` each process trains on its own batches, and gradients are averaged. Ctrl-C or SIGTERM
    stops after the current step and saves.

    Raises:
        ValueError: settings that cannot be, or others than those with which the run in this folder began; captures
            without a frame, or of another body; objective or gradient that are not finite; too little
            memory (says which batch to try).
        FileNotFoundError, FileError: files are missing or
            damaged.
        OSError: there is no room; the last whole state remains.
    """
    with open_run(config, config.mixed_precision) as accelerator:
        captures = open_captures(config.data)
        task = EncoderTask(config, captures, accelerator)
        with accelerator.main_process_first():
            if accelerator.is_main_process:
                about = {"captures": dict(captures.about)}
                begin(config, captures.subjects, about, accelerator.num_processes)
        state = train(task, config, accelerator)
        if accelerator.is_main_process and not (config.run / MODEL).exists():
            task.save(state)  # stopped before the first step
        return task.model(state)


class EncoderTask(Task):
    """An encoder in training; its place in the data is in the state's file."""

    name = ""
    smaller = "fewer --targets, or a smaller --size"

    def __init__(self, config: FitConfig, captures: Captures, accelerator: Accelerator) -> None:
        """Open the data: raises as `fit` for captures, held-out ones, the start and weights of the perceptual loss."""
        self.config, self.captures, self.accelerator = config, captures, accelerator
        self.start = None if config.start is None else _start(config.start, config.architecture)
        self.perceptual = _features(config, accelerator.device)
        self.held = None if config.held is None else open_captures(config.held)
        if self.held is not None:
            betas_of(self.held)
        self.dataset = fit_dataset(captures, config)
        if not len(self.dataset):
            raise ValueError(f"the captures in {config.data} have no frames: render some")
        self._batches: Iterator[Batch] | None = None

    @property
    def settings(self) -> FitConfig:
        """Return the settings of the run."""
        return self.config

    def network(self) -> Encoder:
        """Return the encoder that training starts from."""
        if self.start is not None:
            return self.start.encoder.float().requires_grad_(True).train()
        torch.manual_seed(self.config.seed)
        return Encoder(self.config.architecture)

    def use_network(self, network: nn.Module) -> None:
        """Use an encoder."""
        self.encoder = network

    def optimiser(self, network: nn.Module) -> torch.optim.Optimizer:
        """An untied bias is used once per image, a weight at every pixel: with equal rates the weights diverge."""
        biases = [module.bias for module in network.modules() if isinstance(module, UntiedConv)]
        known = {id(bias) for bias in biases}
        others = [parameter for parameter in network.parameters() if id(parameter) not in known]
        return adamw(self.config, others, (biases, self.config.place_rate))

    def loss(self, step: TrainingStep) -> Mapping[str, Tensor]:
        """Return the weighted terms for the next batch."""
        if self._batches is None:
            start = Position(*parse_json(step.place.get("position", "[0, 0]")))
            share = ProcessRank(self.accelerator.process_index, self.accelerator.num_processes)
            self._batches = fit_batches(self.dataset, self.config, start, share)
        sample, position = next(self._batches)
        step.place["position"] = json.dumps(list(position))
        return self.terms(sample.to(self.accelerator.device), step.number)

    def terms(self, sample: FitSample, number: int) -> Mapping[str, Tensor]:
        """Return the weighted terms for a batch, after `number` steps."""
        config = self.config
        with self.accelerator.autocast():
            payload = self.encoder(sample.found, sample.axis_angle)
        payload = payload.to(dtype=torch.float32)
        if number < config.hold_scale:
            # Multiplied by zero, because distributed training needs a gradient of every parameter.
            payload = dataclasses.replace(payload, delta_scale=sample.found.extent + 0 * payload.delta_scale)
        primitives = Primitives.place(sample.frames, payload)
        views = primitives.map(lambda tensor: tensor[:, None])
        picture = march(views, sample.target.camera, MarchSettings(step=config.step))
        target, mask = sample.target.image.float() / 255, sample.target.mask.float() / 255
        return loss_terms(
            encode_srgb(picture.rgb), picture.alpha, primitives.half_extent, target, mask, config.loss, self.perceptual
        )

    def held_out(self) -> Mapping[str, float]:
        """Return the PSNR of training subjects and of those held out."""
        found = {"psnr_train": measure(self._in_use(), self.captures)}
        return found if self.held is None else {**found, "psnr_held": measure(self._in_use(), self.held)}

    def draw(self, path: Path) -> None:
        """Write a row of images for each subject."""
        write_pictures(path, self._in_use(), self.held or self.captures)

    def save(self, state: TrainingState) -> None:
        """Write the encoder, atomically. A kill before the state is written leaves one newer than the state.

        Raises FileError, leaving the file as it was, if a weight is not finite; OSError.
        """
        save_encoder(self.config.run / MODEL, self.model(state))

    def model(self, state: TrainingState) -> EncoderModel:
        """Return the averaged weights with their card."""
        config, captures = self.config, self.captures
        name = config.encoder if config.ablation is None else f"{config.encoder}, {config.ablation}"
        card = {
            "name": f"PrimDiffusion encoder, {name}",
            "version": __version__,
            "encoder": name,
            "people": len(captures.subjects),
            "captures": {name: value for name, value in captures.about.items() if name != "part_names"},
            "views": config.views,
            "targets": config.targets,
            "size": config.size,
            "steps": state.step,
            "batch": config.batch * self.accelerator.num_processes,
            "seconds": round(state.seconds, 1),
            "device": str(self.accelerator.device),
            "seed": config.seed,
            "loss": parse_json(json.dumps(dataclasses.asdict(config.loss), default=str)),
            "full_density": config.architecture.full_density,
            "start": None if self.start is None else self.start.card,
            **versions(),
        }
        return EncoderModel(_encoder(state.average), card)

    def _in_use(self) -> EncoderModel:
        return EncoderModel(_encoder(self.encoder), {})


def _start(path: Path, config: EncoderConfig) -> EncoderModel:
    start = load_encoder(path)
    if start.config != config:
        raise ValueError(f"{path} is an encoder of other settings: choose its own with --encoder and --ablation")
    return start


def _encoder(network: nn.Module) -> Encoder:
    assert isinstance(network, Encoder)
    return network


def _features(config: FitConfig, device: torch.device) -> Features | None:
    path = config.loss.perceptual_weights
    return load_perceptual(path).to(device) if config.loss.perceptual and path is not None else None


def measure(model: EncoderModel, captures: Captures) -> float:
    """Mean PSNR (dB, images of SIZE x SIZE pixels) of two views of each of a few subjects, in another pose."""
    found = [psnr(image, target) for image, target, _ in _compared(model, captures, "whole")]
    return float(torch.cat(found).mean())


def write_pictures(path: Path, model: EncoderModel, captures: Captures) -> None:
    """Write a row for each subject: an input image, then twice a rendered one beside its capture, in another pose."""
    rows = []
    for image, target, given in _compared(model, captures, "crop"):
        pairs = [side for pair in zip(image, target, strict=True) for side in pair]
        rows.append(torch.cat([given, *pairs], dim=1))
    write_png(path, to_bytes(torch.cat(rows)).numpy())


@torch.no_grad()
def _compared(
    model: EncoderModel, captures: Captures, framing: Literal["whole", "crop"]
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield for each subject two rendered images, the captured ones and an input, sRGB-encoded on the CPU."""
    settings = SampleSettings(8, 2, SIZE, framing, "first")
    dataset = CaptureDataset(captures, settings, SEED)
    device = model.encoder.scale_out.bias.device
    for index in range(min(PEOPLE, len(dataset))):
        sample = dataset[0, index]
        betas = default_betas(captures.subject(captures.subjects[int(sample.subject)]))
        payload = model.encode(sample.conditioning, betas)
        primitives = model.place(payload.to("cpu"), betas, sample.target.pose).to(device)
        picture = march(primitives, sample.target.camera.to(device))
        image = encode_srgb(picture.rgb).cpu()
        yield image, sample.target.image.float() / 255, sample.conditioning.image[0].float() / 255
