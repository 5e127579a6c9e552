"""A loaded generator of people: denoiser, schedule, codec and body shapes in one record."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from primdiffusion.diffusion.codec import LinearCodec, cells_from_payload, payload_from_cells
from primdiffusion.diffusion.conditioning import NOTHING, Attributes, Vocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.samplers import SAMPLERS, Step, gaussian_noise
from primdiffusion.diffusion.schedule import Schedule, trailing_steps
from primdiffusion.formats import requests
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import GRID, K, Payload, S
from primdiffusion.primitives.slab import CHANNELS_PER_LAYER, pack, unpack

BETAS = 10
"""What `sample` does where nothing else is said; guidance is of no effect without a condition."""


class Codec(Protocol):
    """Between what is diffused and a payload."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, height and width of what is diffused."""
        ...

    def to_payload(self, x0: Tensor, full_density: float) -> Payload:
        """The payload of a clean sample [*b, *shape]."""
        ...

    def from_payload(self, payload: Payload, full_density: float) -> Tensor:
        """The clean sample [*b, *shape] of a payload, as far as samples can tell payloads apart."""
        ...

    @property
    def cell_side(self) -> int:
        """Pixels a side that a primitive covers in what is diffused."""
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
        return payload_from_cells(self.codec.decode(x0), full_density, self._dead_zone)

    def from_payload(self, payload: Payload, full_density: float) -> Float[Tensor, "*b c h w"]:
        """Latents; what the basis leaves out is lost."""
        return self.codec.encode(cells_from_payload(payload, full_density, self._dead_zone))

    @property
    def _dead_zone(self) -> tuple[float, float]:
        start, width = self.codec.dead_zone.tolist()
        return start, width

    @property
    def cell_side(self) -> int:
        """1."""
        return 1


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

    def from_payload(self, payload: Payload, full_density: float) -> Float[Tensor, "*b c h w"]:
        """Packed."""
        return pack(payload, full_density)

    @property
    def cell_side(self) -> int:
        """8."""
        return S


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

    def sample(
        self, features: Float[Tensor, "b r"], generator: torch.Generator | Sequence[torch.Generator]
    ) -> Float[Tensor, "b 10"]:
        """Body shapes for people with these coefficients; of one generator, or of one for each person."""
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
    vocabulary: Vocabulary = NOTHING
    """What it can be asked for."""
    chain: Callable[[int, int], list[int]] = trailing_steps
    """Descending t that a sampler visits, from the schedule's length and the number of steps."""
    body_setup: BodySetup | None = None
    """Body and anchors of the humans it generates; None is the default body."""

    @property
    def device(self) -> torch.device:
        """Where the denoiser's parameters are."""
        return next(iter(self.denoiser.state_dict().values())).device

    def to(self, device: torch.device | str) -> DiffusionModel:
        """The same model on another device; moves the networks in place."""
        codec = CellCodec(self.codec.codec.to(device)) if isinstance(self.codec, CellCodec) else self.codec
        return dataclasses.replace(self, denoiser=self.denoiser.to(device), codec=codec, shapes=self.shapes.to(device))

    def condition(self, attributes: Attributes) -> Float[Tensor, "a"] | None:
        """What is asked for, as the denoiser understands it; None for nothing.

        Raises ValueError for attributes or values that the model does not know.
        """
        encoded = self.vocabulary.encode(attributes)
        return encoded.to(self.device) if attributes else None

    def denoise(
        self, x: Float[Tensor, "b c h w"], t: int, condition: Float[Tensor, "#b a"] | None = None, guidance: float = 1.0
    ) -> Float[Tensor, "b c h w"]:
        """The denoiser's x0 guess without gradients, all samples at step t.

        With a condition: u + guidance (c - u) of the guesses u for anybody and c for people as asked for (Ho and
        Salimans 2022). 1 is the plain conditional guess, more exaggerates what was asked for at the cost of variety.
        """
        steps = torch.full((len(x),), t, dtype=torch.int64, device=x.device)
        with torch.inference_mode():
            if condition is None:
                return self.denoiser(x, steps)
            condition = condition.expand(len(x), -1)
            asked = self.denoiser(x, steps, condition)
            if guidance == 1.0:
                return asked
            return torch.lerp(self.denoiser(x, steps), asked, guidance)

    def start(
        self, generators: Sequence[torch.Generator], t: int, condition: Float[Tensor, "#b a"] | None = None
    ) -> Float[Tensor, "b c h w"]:
        """Samples at step t to start from, one of each generator: signal * (a draw of the person prior) + noise * eps.

        The paper starts from noise alone. People correlate so strongly that their first components still show at T-1,
        and a start without them loses variety; the prior's draw is exact there to second order. Without a prior: noise
        alone.
        """
        conditions = None if condition is None else condition.expand(len(generators), -1)
        return torch.cat(
            [self._start(one, t, None if conditions is None else conditions[i : i + 1])
             for i, one in enumerate(generators)]
        )  # fmt: skip

    def _start(
        self, generator: torch.Generator, t: int, condition: Float[Tensor, "1 a"] | None
    ) -> Float[Tensor, "1 c h w"]:
        noise = torch.randn((1, *self.codec.shape), generator=generator, device=generator.device)
        x = self.schedule.noise(t) * noise.to(self.device)
        if isinstance(self.denoiser, PersonDenoiser):
            x = x + self.schedule.signal(t) * self.denoiser.prior.sample(1, generator, condition)
        return x

    def decode(self, x0: Float[Tensor, "*b c h w"]) -> Payload:
        """The payload of clean samples: colours linear in [0, 1], densities 1/m >= 0, ordinary tensors."""
        return self.codec.to_payload(x0, self.full_density)

    def encode(self, payload: Payload) -> Float[Tensor, "*b c h w"]:
        """The clean samples that are nearest to payloads, on the model's device."""
        return self.codec.from_payload(payload.to(self.device), self.full_density)

    def cell_mask(self, region: Bool[Tensor, "k"]) -> Bool[Tensor, "h w"]:
        """Which pixels of what is diffused belong to the primitives of a region; ValueError for another number."""
        if tuple(region.shape) != (K,) or region.dtype != torch.bool:
            raise ValueError(f"a region is {K} yes or no; this one is {region.dtype} {tuple(region.shape)}")
        side = self.codec.cell_side
        grid = region.to(self.device).unflatten(0, (GRID, GRID))
        return grid.repeat_interleave(side, 0).repeat_interleave(side, 1)

    def betas(self, x0: Float[Tensor, "b c h w"], seeds: Sequence[int]) -> Float[Tensor, "b 10"]:
        """Body shapes that suit clean samples; the same for the same sample and seed."""
        features = x0.new_zeros((len(x0), 0))
        wanted = self.shapes.weight.shape[1]
        if wanted and isinstance(self.denoiser, PersonDenoiser):
            coefficients, _ = self.denoiser.prior.split(x0)
            features = (coefficients / self.denoiser.component_std)[:, :wanted]
        return self.shapes.sample(features, [seeded(seed) for seed in seeds])


def sample(
    model: DiffusionModel,
    seeds: Sequence[int],
    steps: int = requests.STEPS,
    sampler: str = requests.SAMPLERS[0],
    condition: Float[Tensor, "#b a"] | None = None,
    guidance: float = requests.GUIDANCE,
) -> Iterator[Step]:
    """Generate a person of each seed, yielding every step; the last step's x0 is the result (30 DDIM steps by default).

    The same seeds in the same batch give the same bits on one device with one version of torch and number of threads.
    A seed's noise is the same in any batch and on any device; so is the person, but for rounding. Stop asking to
    cancel. ValueError for an unknown sampler, no seeds, a seed outside 0 ... 2^63-1 or a number of steps outside
    1 ... T.
    """
    if sampler not in SAMPLERS:
        raise ValueError(f"there is no sampler {sampler!r}; choose one of {', '.join(sorted(SAMPLERS))}")
    if not len(seeds):
        raise ValueError("no seeds were given: a person needs one")
    chain = model.chain(model.schedule.length, steps)
    generators = [seeded(seed) for seed in seeds]
    start = model.start(generators, chain[0], condition)

    def denoise(x: Tensor, t: int) -> Tensor:
        return model.denoise(x, t, condition, guidance)

    return SAMPLERS[sampler](denoise, model.schedule, start, chain, generators)


def seeded(seed: int) -> torch.Generator:
    """A generator in the state of `seed`; ValueError for a seed that is no unsigned 63-bit number.

    On the processor, whatever the model is on: devices have generators of their own, and a seed is to be one person.
    """
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed {seed} is out of range; choose a whole number from 0 to {2**63 - 1}")
    return torch.Generator().manual_seed(seed)
