"""The part of training that both presets of the diffusion model share: optimiser, held-out errors, pictures; and
the preset `paper`: the paper's U-Net on whole slabs (paper sec. 3.3, SPEC 3).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from primdiffusion.diffusion.codec import WholeSlab
from primdiffusion.diffusion.model import STANDARD_SHAPES, DiffusionModel
from primdiffusion.diffusion.samplers import gaussian_noise
from primdiffusion.diffusion.schedule import linear
from primdiffusion.diffusion.unet import SlabUNet
from primdiffusion.files.picture_files import write_png
from primdiffusion.geometry.image import encode_srgb, to_bytes
from primdiffusion.human import framing, generate_batch, place
from primdiffusion.people.stored_people import PersonFolder, payload_of_bytes
from primdiffusion.primitives.primitives import pack
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.runtime.device import has_bfloat16, has_fast_bfloat16
from primdiffusion.training.config import NetworkTraining, TrainingConfig
from primdiffusion.training.loop import Task, TrainingStep
from primdiffusion.training.losses import random_steps, x0_errors
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
    def settings(self) -> NetworkTraining:
        """Return the settings of the network."""

    @abstractmethod
    def errors(self) -> Mapping[int, float]:
        """Return the root mean square x0 error on held-out people, by level."""

    @abstractmethod
    def model(self) -> DiffusionModel:
        """Return the model with the network in use, without a card."""

    def optimiser(self, network: nn.Module) -> torch.optim.Optimizer:
        """Return Muon where the settings name it and the device has instructions for bfloat16, otherwise AdamW."""
        settings = self.settings
        if settings.optimiser == "muon" and has_bfloat16(self.device):
            return MuonAdamW(network, settings.learning_rate, settings.weight_decay)
        return super().optimiser(network)

    def held_out(self) -> Mapping[str, float]:
        """Return `errors`, named after their levels."""
        return {f"rms_{level}": error for level, error in self.errors().items()}

    def draw(self, path: Path) -> None:
        """Render a few samples side by side."""
        write_samples(path, self.model())

    def save(self, state: TrainingState) -> None:
        """Write nothing: the model is written when a run ends, with its held-out errors."""


@torch.no_grad()
def write_samples(path: Path, model: DiffusionModel) -> None:
    """Write an image of the humans of SEEDS, side by side over black. Raises OSError."""
    pictures = []
    for human in generate_batch(model, SEEDS):
        primitives = place(human)
        camera = framing(primitives, YAW_DEGREES, WIDTH, HEIGHT).to(model.device)
        rendering = march(primitives.to(model.device), camera, MarchSettings(step=STEP))
        pictures.append(encode_srgb(rendering.rgb.clamp(0, 1)).cpu())
    write_png(path, to_bytes(torch.cat(pictures, dim=1)).numpy())


MEASURED = 4
"""Held-out humans used in evaluation, one colouring each: a slab takes 15 MB, its evaluation the time of a step."""


class SlabTask(DiffusionTask):
    """A `SlabUNet` and its training data: unweighted x0 error at uniform levels, as in the paper."""

    name = "slab"

    def __init__(
        self,
        config: TrainingConfig,
        people: PersonFolder,
        train: Sequence[int],
        held: Sequence[int],
        device: torch.device,
    ) -> None:
        torch.manual_seed(config.seed)
        self.schedule = linear()
        self.config, self.people, self.held, self.device = config.slab, people, held[:MEASURED], device
        self.places = [(index, number) for index in train for number in range(people.variants[index])]
        self.denoiser: nn.Module = SlabUNet(config.unet).to(device)

    @property
    def settings(self) -> NetworkTraining:
        """Return the settings of the U-Net."""
        return self.config

    def network(self) -> nn.Module:
        """Return the U-Net."""
        return self.denoiser

    def use_network(self, network: nn.Module) -> None:
        """Use a network as the denoiser."""
        self.denoiser = network

    def slabs(self, places: Sequence[tuple[int, int]]) -> Float[Tensor, "b 56 256 256"]:
        """Load slabs. Raises ValueError, naming a damaged file, and OSError."""
        with ThreadPoolExecutor() as threads:  # unpacking releases the interpreter
            read = threads.map(self.people.variant, *zip(*places, strict=True))
            voxels, scales = zip(*read, strict=True)
        density = self.people.full_density
        payload = payload_of_bytes(torch.stack(voxels).to(self.device), torch.stack(scales).to(self.device), density)
        return pack(payload, density)

    def loss(self, step: TrainingStep) -> Mapping[str, Tensor]:
        """x0 error of a random batch at random levels (paper eq. 9)."""
        generator = step.generator
        chosen = torch.randint(
            len(self.places), (self.config.batch,), generator=generator, device=generator.device
        ).tolist()
        slab = self.slabs([self.places[index] for index in chosen])
        t = random_steps(self.schedule, len(slab), generator, self.config)
        x = self.schedule.q_sample(slab, t, gaussian_noise(slab, generator))
        loss = (self._guess(x, t) - slab).square().mean()
        return {"loss": loss}

    def errors(self) -> Mapping[int, float]:
        """Evaluate on the first colourings of a few held-out humans, in units of the slab."""
        held = self.slabs([(index, 0) for index in self.held])
        return x0_errors({"rms": self._guess}, self.schedule, held, batch=1)["rms"]

    def model(self) -> DiffusionModel:
        """Return the model without a card; body shapes are not modelled."""
        density = self.people.full_density
        return DiffusionModel(self.denoiser, self.schedule, WholeSlab(), STANDARD_SHAPES, density, {})

    def _guess(self, x: Float[Tensor, "b 56 256 256"], t: Tensor) -> Float[Tensor, "b 56 256 256"]:
        fast = self.config.bfloat16 and has_fast_bfloat16(x.device)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=fast):
            return self.denoiser(x, t).float()
