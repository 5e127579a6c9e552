"""A loaded generator of people: denoiser, schedule, codec and body shapes in one record."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from primdiffusion.diffusion.codec import LinearCodec, payload_from_cells
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.samplers import SAMPLERS, Step, gaussian_noise
from primdiffusion.diffusion.schedule import Schedule, trailing_steps
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import GRID, Payload, S
from primdiffusion.primitives.slab import CHANNELS_PER_LAYER, unpack

BETAS = 10


class Codec(Protocol):
    """Between what is diffused and a payload."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, height and width of what is diffused."""
        ...

    def to_payload(self, x0: Tensor, full_density: float) -> Payload:
        """The payload of a clean sample [*b, *shape]."""
        ...


@dataclasses.dataclass(frozen=True)
class CellCodec:
    """Latents of the default denoiser."""

    codec: LinearCodec

    @property
    def shape(self) -> tuple[int, int, int]:
        """[C, 32, 32]."""
        return self.codec.basis.shape[0], GRID, GRID

    def to_payload(self, x0: Float[Tensor, "*b c h w"], full_density: float) -> Payload:
        """Clamped, dead zone applied."""
        return payload_from_cells(self.codec.decode(x0), full_density)


@dataclasses.dataclass(frozen=True)
class WholeSlab:
    """No codec: the slab itself is diffused, as in the paper."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """[56, 256, 256]."""
        return S * CHANNELS_PER_LAYER, GRID * S, GRID * S

    def to_payload(self, x0: Float[Tensor, "*b c h w"], full_density: float) -> Payload:
        """Unpacked and clamped."""
        return unpack(x0, full_density)


@dataclasses.dataclass(frozen=True)
class ShapePrior(TensorRecord):
    """Body shapes given the person that wears them: betas ~ N(bias + weight x0_features, scale scale^T)."""

    weight: Float[Tensor, "10 r"]
    """On the first r person coefficients in standard deviations; r may be 0."""
    bias: Float[Tensor, "10"]
    scale: Float[Tensor, "10 10"]
    """Lower triangular factor of the covariance that is left."""
    limit: Float[Tensor, "10"]
    """Largest absolute value of each beta among the training people; draws are clamped to it."""

    def sample(self, features: Float[Tensor, "*b r"], generator: torch.Generator) -> Float[Tensor, "*b 10"]:
        """Body shapes for people with these coefficients."""
        mean = features @ self.weight.T + self.bias
        return (mean + gaussian_noise(mean, generator) @ self.scale.T).clamp(-self.limit, self.limit)


STANDARD_SHAPES = ShapePrior(torch.zeros(BETAS, 0), torch.zeros(BETAS), torch.eye(BETAS), torch.full((BETAS,), 3.0))
"""Independent standard normal betas, for models that know nothing of shapes."""


@dataclasses.dataclass(frozen=True)
class DiffusionModel:
    """What `load_checkpoint` returns and `sample` needs."""

    denoiser: nn.Module
    """x0 guess of (x [b, *shape], t [b])."""
    schedule: Schedule
    codec: Codec
    shapes: ShapePrior
    full_density: float
    """1/m that a stored density of 1 stands for."""
    card: Mapping[str, Any]
    """Where the weights come from and what was measured on them."""

    @property
    def device(self) -> torch.device:
        """Where the denoiser's parameters are."""
        return next(iter(self.denoiser.state_dict().values())).device

    def to(self, device: torch.device | str) -> DiffusionModel:
        """The same model on another device; moves the networks in place."""
        codec = CellCodec(self.codec.codec.to(device)) if isinstance(self.codec, CellCodec) else self.codec
        return dataclasses.replace(self, denoiser=self.denoiser.to(device), codec=codec, shapes=self.shapes.to(device))

    def denoise(self, x: Float[Tensor, "b c h w"], t: int) -> Float[Tensor, "b c h w"]:
        """The denoiser's x0 guess without gradients, all samples at step t."""
        with torch.inference_mode():
            return self.denoiser(x, torch.full((len(x),), t, dtype=torch.int64, device=x.device))

    def start(self, count: int, generator: torch.Generator, t: int) -> Float[Tensor, "count c h w"]:
        """Samples at step t to start from: signal * (a draw of the person prior) + noise * eps.

        The paper starts from noise alone. People correlate so strongly that their first components still show at T-1,
        and a start without them loses variety; the prior's draw is exact there to second order. Without a prior: noise
        alone.
        """
        noise = torch.randn((count, *self.codec.shape), generator=generator, device=generator.device)
        x = self.schedule.noise(t) * noise
        if isinstance(self.denoiser, PersonDenoiser):
            x = x + self.schedule.signal(t) * self.denoiser.prior.sample(count, generator)
        return x

    def decode(self, x0: Float[Tensor, "*b c h w"]) -> Payload:
        """The payload of clean samples: colours linear in [0, 1], densities 1/m >= 0, ordinary tensors."""
        return self.codec.to_payload(x0, self.full_density)

    def betas(self, x0: Float[Tensor, "b c h w"], seed: int) -> Float[Tensor, "b 10"]:
        """Body shapes that suit clean samples; the same for the same samples and seed."""
        features = x0.new_zeros((len(x0), 0))
        wanted = self.shapes.weight.shape[1]
        if wanted and isinstance(self.denoiser, PersonDenoiser):
            coefficients, _ = self.denoiser.prior.split(x0)
            features = (coefficients / self.denoiser.component_std)[:, :wanted]
        return self.shapes.sample(features, seeded(seed, x0.device))


def sample(
    model: DiffusionModel,
    seed: int | torch.Generator,
    steps: int = 30,
    sampler: str = "ddim",
    count: int = 1,
) -> Iterator[Step]:
    """Generate `count` people, yielding every step; the last step's x0 is the result (30 DDIM steps by default).

    Deterministic for a seed, device and count. Stop asking to cancel. ValueError for an unknown sampler or a number of
    steps outside 1 ... T.
    """
    if sampler not in SAMPLERS:
        raise ValueError(f"there is no sampler {sampler!r}; choose one of {', '.join(sorted(SAMPLERS))}")
    chain = trailing_steps(model.schedule.length, steps)
    generator = seed if isinstance(seed, torch.Generator) else seeded(seed, model.device)
    start = model.start(count, generator, chain[0])
    return SAMPLERS[sampler](model.denoise, model.schedule, start, chain, generator)


def seeded(seed: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator on `device` in the state of `seed`; ValueError for a seed that is no unsigned 63-bit number."""
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed {seed} is out of range; choose a whole number from 0 to {2**63 - 1}")
    return torch.Generator(device=device).manual_seed(seed)
