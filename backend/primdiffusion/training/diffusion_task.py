"""What training of either preset of the diffusion model has in common: optimiser, held-out errors, pictures."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import nn

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.files.picture_files import write_png
from primdiffusion.formats import requests
from primdiffusion.geometry.image import encode_srgb, to_bytes
from primdiffusion.human import framing, generate_batch, place
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.runtime.device import has_bfloat16
from primdiffusion.training.config import PhaseConfig
from primdiffusion.training.loop import Task
from primdiffusion.training.muon import MuonAdamW
from primdiffusion.training.state import TrainingState

SEEDS = (0, 1, 2, 3)
"""Seeds of the samples in pictures."""
WIDTH, HEIGHT = 256, 256
YAW_DEGREES = 23
STEP = 0.006
"""Metres between samples of a ray."""


class DiffusionTask(Task):
    """A diffusion model in training."""

    device: torch.device
    smaller = "a smaller network, or another device"

    @property
    @abstractmethod
    def phases(self) -> Mapping[str, PhaseConfig]:
        """Return the settings of the model's networks."""

    @abstractmethod
    def errors(self) -> Mapping[int, float]:
        """Return the root mean square x0 error on held-out people, by level."""

    @abstractmethod
    def model(self) -> DiffusionModel:
        """Return the model with the networks in use, without a card."""

    def optimiser(self, phase: str, network: nn.Module) -> torch.optim.Optimizer:
        """Return Muon where the settings name it and the device has instructions for bfloat16, otherwise AdamW."""
        settings = self.phases[phase]
        if settings.optimiser == "muon" and has_bfloat16(self.device):
            return MuonAdamW(network, settings.learning_rate, settings.weight_decay)
        return super().optimiser(phase, network)

    def held_out(self) -> Mapping[str, float]:
        """Return `errors`, named after their levels."""
        return {f"rms_{level}": error for level, error in self.errors().items()}

    def draw(self, path: Path) -> None:
        """Render a few samples side by side."""
        write_samples(path, self.model())

    def save(self, state: TrainingState) -> None:
        """Write nothing: the model is written when a run ends, with its held-out errors."""


@torch.no_grad()
def write_samples(
    path: Path, model: DiffusionModel, seeds: Sequence[int] = SEEDS, steps: int = requests.Sampling.steps
) -> None:
    """Write an image of humans of `seeds`, side by side over black. Raises OSError."""
    pictures = []
    for human in generate_batch(model, seeds, steps):
        primitives = place(human)
        camera = framing(primitives, YAW_DEGREES, WIDTH, HEIGHT).to(model.device)
        rendering = march(primitives.to(model.device), camera, MarchSettings(step=STEP))
        pictures.append(encode_srgb(rendering.rgb.clamp(0, 1)).cpu())
    write_png(path, to_bytes(torch.cat(pictures, dim=1)).numpy())
