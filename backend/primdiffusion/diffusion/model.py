"""A loaded diffusion model: denoiser, schedule, codec and shape prior in one record; whether parts from a file fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from primdiffusion.body.model import LARGEST_BETA
from primdiffusion.diffusion.codec import VALUES, CellCodec, Codec, LinearCodec, payload_from_cells
from primdiffusion.diffusion.conditioning import NOTHING, Attributes, AttributeVocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.samplers import SAMPLERS, SamplerStep, gaussian_noise
from primdiffusion.diffusion.schedule import CLEAN, Schedule, trailing_steps
from primdiffusion.diffusion.surfaces import LARGEST, LARGEST_SIZE, Surfaces
from primdiffusion.formats import requests
from primdiffusion.geometry.records import TensorRecord, check_shapes
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import GRID, K, Payload
from primdiffusion.runtime.device import GRID_THREADS, SLAB_THREADS, each_with_fixed_threads, fixed_threads

BETAS = 10
"""Shape coefficients of a sampled body."""
VISIBLE = 0.01
"""Smallest difference of encoded colours that counts."""
LARGEST_ENTRY = 1.01
"""Largest entry of a basis row of length 1 that a file rounds to half precision."""


@dataclasses.dataclass(frozen=True)
class ShapePrior(TensorRecord):
    """Body shapes given the rest of the person: betas ~ N(bias + weight x0_features, scale scale^T)."""

    weight: Float[Tensor, "10 r"]
    """On the first r person coefficients in standard deviations; r may be 0."""
    bias: Float[Tensor, "10"]
    scale: Float[Tensor, "10 10"]
    """Lower triangular factor of the residual covariance."""
    limit: Float[Tensor, "10"]
    """Largest absolute value of each beta among the training people; draws are clamped to it."""

    def sample(
        self, features: Float[Tensor, "b r"], generator: torch.Generator | Sequence[torch.Generator]
    ) -> Float[Tensor, "b 10"]:
        """Draw body shapes for these coefficients, from one generator or one for each sample."""
        mean = features @ self.weight.T + self.bias
        return (mean + gaussian_noise(mean, generator) @ self.scale.T).clamp(-self.limit, self.limit)


STANDARD_SHAPES = ShapePrior(torch.zeros(BETAS, 0), torch.zeros(BETAS), torch.eye(BETAS), torch.full((BETAS,), 3.0))
"""Independent standard normal betas, for models without a shape prior."""


@dataclasses.dataclass(frozen=True, eq=False)
class DiffusionModel:
    """A loaded diffusion model, ready to sample."""

    denoiser: nn.Module
    """x0 guess of (x [b, *shape], t [b])."""
    schedule: Schedule
    codec: Codec
    shapes: ShapePrior
    full_density: float
    """1/m that a stored density of 1 stands for."""
    card: Mapping[str, Any]
    """Origin of the weights and their measured errors."""
    vocabulary: AttributeVocabulary = NOTHING
    """Attributes that it can be conditioned on."""
    chain: Callable[[int, int], list[int]] = trailing_steps
    """Descending t that a sampler visits, from the schedule's length and the number of steps."""
    body_setup: BodySetup | None = None
    """Body and anchors of the humans it generates; None is the default body."""
    surfaces: Surfaces | None = None
    """Hair, hats, garments and skin that `decode` gives one colour each; for a person prior with attributes."""

    @property
    def device(self) -> torch.device:
        """Device of the denoiser's parameters."""
        return next(iter(self.denoiser.state_dict().values())).device

    @property
    def threads(self) -> int:
        """Threads that sampling uses on a CPU, whatever its number of cores (`fixed_threads`)."""
        return GRID_THREADS if isinstance(self.codec, CellCodec) else SLAB_THREADS

    def to(self, device: torch.device | str) -> DiffusionModel:
        """The same model on another device; moves the networks in place."""
        codec = self.codec.to(device) if isinstance(self.codec, CellCodec) else self.codec
        surfaces = None if self.surfaces is None else self.surfaces.to(device)
        return dataclasses.replace(
            self, denoiser=self.denoiser.to(device), codec=codec, shapes=self.shapes.to(device), surfaces=surfaces
        )

    def condition(self, attributes: Attributes) -> Float[Tensor, "a"] | None:
        """Encode attributes for the denoiser; None without attributes.

        Raises ValueError for attributes or values unknown to the model.
        """
        encoded = self.vocabulary.encode(attributes)
        return encoded.to(self.device) if attributes else None

    def denoise(
        self, x: Float[Tensor, "b c h w"], t: int, condition: Float[Tensor, "#b a"] | None = None, guidance: float = 1.0
    ) -> Float[Tensor, "b c h w"]:
        """The denoiser's x0 guess without gradients, all samples at step t.

        With a condition, `guidance` is that of `PersonDenoiser.forward`: 1 is the plain conditional guess; more follows
        the condition more closely at the cost of variety.
        """
        steps = torch.full((len(x),), t, dtype=torch.int64, device=x.device)
        with torch.inference_mode():
            if condition is None:
                return self.denoiser(x, steps)
            return self.denoiser(x, steps, condition.expand(len(x), -1), guidance)

    def complete(
        self, generators: Sequence[torch.Generator], condition: Float[Tensor, "#b a"] | None = None
    ) -> Float[Tensor, "b a"] | None:
        """Return a condition for each generator: what `condition` asks for, and categories drawn for the others.

        They are drawn as they occur together among the training people. With all categories given the denoiser draws
        one outfit; with some left open it can mix several. Returns `condition` for a model without attributes.
        """
        if not self.vocabulary.width or not isinstance(self.denoiser, PersonDenoiser):
            return condition
        asked = torch.zeros(1, self.vocabulary.width, device=self.device) if condition is None else condition
        asked = asked.expand(len(generators), -1)
        prior = self.denoiser.prior
        drawn = [prior.sample_kinds(1, one, asked[i : i + 1]) for i, one in enumerate(generators)]
        return self.vocabulary.complete(asked, torch.cat(drawn))

    def start(
        self, generators: Sequence[torch.Generator], t: int, condition: Float[Tensor, "#b a"] | None = None
    ) -> Float[Tensor, "b c h w"]:
        """Return initial samples at step t, one a generator: signal * (a draw of the person prior) + noise * eps.

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

    def decode(self, x0: Float[Tensor, "*b c h w"], kind: Float[Tensor, "b a"] | None = None) -> Payload:
        """The payload of clean samples: colours linear in [0, 1], densities 1/m >= 0, ordinary tensors.

        Hair, hats, plain garments and skin have one colour each, and skirts are whole (`Surfaces`), as people of
        `kind` have them; None reads it from the samples.
        """
        prior = self._prior_of_surfaces()
        if prior is None:
            return self.codec.to_payload(x0, self.full_density)
        assert self.surfaces is not None
        assert isinstance(self.codec, CellCodec)
        codec, samples = self.codec.codec, x0.reshape(-1, *self.codec.shape)
        if kind is None:
            kind = prior.expected_kind(prior.split(samples)[0])
        samples = self._recoloured(prior, samples, kind, self.surfaces.natural_colours)
        cells = self.surfaces.draw(codec.decode(samples), kind).view(*x0.shape[:-3], K, VALUES)
        return payload_from_cells(cells, self.full_density, codec.zone)

    def with_peoples_colours(self, x0: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Clean samples of the chain, moved to where clothes, hair and skin have colours of people.

        Not for encoded people, who have them.
        """
        prior = self._prior_of_surfaces()
        if prior is None:
            return x0
        assert self.surfaces is not None
        return self._recoloured(prior, x0, prior.expected_kind(prior.split(x0)[0]), self.surfaces.peoples_colours)

    def _prior_of_surfaces(self) -> PersonPrior | None:
        """The closed form, if it and the codec are those of surfaces."""
        prior = getattr(self.denoiser, "prior", None)
        with_surfaces = self.surfaces is not None and isinstance(self.codec, CellCodec)
        return prior if with_surfaces and isinstance(prior, PersonPrior) else None

    def _recoloured(
        self,
        prior: PersonPrior,
        samples: Float[Tensor, "b c h w"],
        kind: Float[Tensor, "b a"],
        colours: Callable[[Tensor, Tensor], Float[Tensor, "2 q 3"]],
    ) -> Float[Tensor, "b c h w"]:
        """Samples moved from the first of the colours that surfaces find in their cells to the second, with all that
        goes with them.

        A Gaussian has hair darker than black, and then foreheads that make up for it by pale spots.
        """
        assert isinstance(self.codec, CellCodec)
        codec, moved = self.codec.codec, []
        for x0, its in zip(samples, kind, strict=True):
            with torch.inference_mode(False), torch.enable_grad():
                cells = codec.decode(x0.clone()).requires_grad_()
                own, drawn = colours(cells, its.clone()).flatten(1)
                by_cells = (torch.autograd.grad(value, cells, retain_graph=True)[0] for value in own)
                wanted = (drawn - own).detach()
                if (wanted.abs() > VISIBLE).any():
                    slopes = prior.along(torch.stack([codec.pulled_back(each) for each in by_cells]))
                    coefficients, _ = prior.split(x0[None])
                    change = prior.moved(coefficients[0], slopes, wanted)[None] - coefficients
                    x0 = x0 + prior.picture(change)[0]
            moved.append(x0)
        return torch.stack(moved)

    def read_condition(self, x0: Float[Tensor, "b c h w"]) -> Float[Tensor, "b a"] | None:
        """Probabilities of attributes of clean samples, as a condition, with garments of one colour plain; None for a
        model without them."""
        prior = getattr(self.denoiser, "prior", None)
        if not self.vocabulary.width or not isinstance(prior, PersonPrior):
            return None
        kind = prior.expected_kind(prior.split(x0)[0])
        for number, one in enumerate(x0):
            if self.plain_after_all(one[None]):
                block = self.vocabulary.blocks()["pattern"]
                kind[number, block] = self.vocabulary.encode({"pattern": "plain"}).to(kind)[block]
        return kind

    def plain_after_all(self, x0: Float[Tensor, "1 c h w"]) -> bool:
        """Whether the prior takes a person for patterned whose garments have one colour each, but for small prints.

        It does so with clothes that are unlike those of the training set: patterned people differ more there.
        """
        prior, words = getattr(self.denoiser, "prior", None), self.vocabulary.categories.get("pattern", ())
        if self.surfaces is None or not isinstance(prior, PersonPrior) or "plain" not in words:
            return False
        assert isinstance(self.codec, CellCodec)
        plain, block = self.vocabulary.encode({"pattern": "plain"}).to(x0), self.vocabulary.blocks()["pattern"]
        kind = prior.expected_kind(prior.split(x0)[0])[0].to(x0)
        if kind @ plain > 0.5:
            return False
        kind[block] = plain[block]
        return self.surfaces.even(self.codec.codec.decode(x0)[0], kind, plain)

    def encode(self, payload: Payload) -> Float[Tensor, "*b c h w"]:
        """The clean samples nearest to payloads, on the model's device."""
        return self.codec.from_payload(payload.to(self.device), self.full_density)

    def cell_mask(self, region: Bool[Tensor, "k"]) -> Bool[Tensor, "h w"]:
        """Mask pixels of a sample that belong to a region of primitives; ValueError for another shape or dtype."""
        if tuple(region.shape) != (K,) or region.dtype != torch.bool:
            raise ValueError(f"a region is a bool mask [{K}]; this one is {region.dtype} {tuple(region.shape)}")
        side = self.codec.cell_side
        grid = region.to(self.device).unflatten(0, (GRID, GRID))
        return grid.repeat_interleave(side, 0).repeat_interleave(side, 1)

    def betas(self, x0: Float[Tensor, "b c h w"], seeds: Sequence[int]) -> Float[Tensor, "b 10"]:
        """Draw body shapes that match clean samples; deterministic in sample and seed."""
        features = x0.new_zeros((len(x0), 0))
        wanted = self.shapes.weight.shape[1]
        if wanted and isinstance(self.denoiser, PersonDenoiser):
            coefficients, _ = self.denoiser.prior.split(x0)
            features = (coefficients / self.denoiser.component_std)[:, :wanted]
        return self.shapes.sample(features, [seeded_generator(seed) for seed in seeds])


def sample(
    model: DiffusionModel,
    seeds: Sequence[int],
    steps: int = requests.Sampling.steps,
    sampler: str = requests.GenerateRequest.sampler,
    condition: Float[Tensor, "#b a"] | None = None,
    guidance: float = requests.Conditioning.guidance,
    end: int = CLEAN,
) -> Iterator[SamplerStep]:
    """Generate a person for each seed, yielding every step; the last step's x is the result (default: DPM-Solver++).

    The same batch of seeds gives the same bits on one kind of device with one version of torch, on any number of cores.
    A seed's noise is the same in any batch and on any device, so the person is the same up to rounding. Categories that
    `condition` leaves open are drawn (`DiffusionModel.complete`). To cancel, stop iterating.
    `end` is that of `ddim`; other samplers end at `CLEAN`.
    ValueError for an unknown sampler, no seeds, a seed outside 0 ... 2^63-1 or a number of steps outside 1 ... T.
    """
    if sampler not in SAMPLERS:
        raise ValueError(f"there is no sampler {sampler!r}; choose one of {', '.join(sorted(SAMPLERS))}")
    if end != CLEAN and sampler != "ddim":
        raise ValueError(f"the sampler {sampler} ends at the clean sample: choose ddim to end at level {end}")
    if not len(seeds):
        raise ValueError("no seeds were given: give one for each human")
    chain = model.chain(model.schedule.length, steps)
    generators = [seeded_generator(seed) for seed in seeds]
    with fixed_threads(model.threads):
        conditions = model.complete(generators, condition)
        start = model.start(generators, chain[0], conditions)

    def denoise(x: Tensor, t: int) -> Tensor:
        return model.denoise(x, t, conditions, guidance)

    ending = {} if end == CLEAN else {"end": end}
    steps_taken = SAMPLERS[sampler](denoise, model.schedule, start, chain, generators, **ending)
    return each_with_fixed_threads(steps_taken, model.threads)


def seeded_generator(seed: int) -> torch.Generator:
    """Return a CPU generator seeded with `seed`; ValueError unless 0 <= seed < 2^63.

    Always on the CPU: each kind of device has its own random number generator, and a seed should give one person.
    """
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed {seed} is out of range; choose an integer from 0 to 2^63 - 1")
    return torch.Generator().manual_seed(seed)


def check_codec(codec: LinearCodec) -> None:
    """Raise ValueError unless the tensors of a codec fit each other and the primitives."""
    check_shapes(codec)
    if not bool((codec.weight > 0).all()) or bool((codec.basis.abs() > LARGEST_ENTRY).any()):
        raise ValueError("a weight of the codec is not positive, or its basis has rows longer than 1")
    if codec.region.shape != (K,) or not bool(((codec.region >= 0) & (codec.region < len(codec.basis))).all()):
        raise ValueError(f"regions of the codec are not {K} numbers below {len(codec.basis)}")
    if tuple(codec.mean.shape) != (K, VALUES):
        raise ValueError(f"mean has shape {tuple(codec.mean.shape)}, not {K} x {VALUES}")


def check_parts(codec: LinearCodec, prior: PersonPrior, shapes: ShapePrior, vocabulary: AttributeVocabulary) -> None:
    """Raise ValueError unless prior, body shapes and vocabulary have the sizes and values of one model, with a codec
    that passes `check_codec`."""
    latents = (codec.channels, GRID, GRID)
    if latents != tuple(prior.mean.shape):
        raise ValueError(f"codec latents are {latents}, the network expects {tuple(prior.mean.shape)}")
    check_shapes(codec, prior)
    check_shapes(shapes)
    _check_values(prior, shapes)
    own, cells, drawn = prior.basis.shape
    parts, components = int(prior.part.max()) + 1, len(prior.parity)
    if cells != K or not 0 < drawn <= codec.channels:
        raise ValueError(f"components draw {drawn} channels of {cells} cells, not up to {codec.channels} of {K}")
    if components != parts * own or components != prior.axes.shape[2] + prior.head_axes.shape[2]:
        raise ValueError(f"{components} components are not {own} for each of {parts} parts")
    for name, index, count in (("part", prior.part, parts), ("head", prior.head, len(prior.head_left))):
        if bool((index < 0).any()) or bool((index >= count).any()):
            raise ValueError(f"{name} has numbers that are not from 0 to {count - 1}")
    if len(prior.part.bincount()) != parts or not bool((prior.part.bincount() > 0).all()):
        raise ValueError("a part of the body has no cells")
    if shapes.weight.shape[1] > components:
        raise ValueError(f"body shapes depend on {shapes.weight.shape[1]} components of {components}")
    if prior.kind.shape[-1] not in (0, vocabulary.width):
        raise ValueError(f"parts are described by {prior.kind.shape[-1]} values, attributes by {vocabulary.width}")


def check_surfaces(surfaces: Surfaces, vocabulary: AttributeVocabulary) -> None:
    """Raise ValueError unless surfaces are of primitives and of people with this vocabulary."""
    check_shapes(surfaces)
    if surfaces.condition.shape[1] != vocabulary.width:
        raise ValueError(f"surfaces are described by {surfaces.condition.shape[1]} values, not {vocabulary.width}")
    kinds, prints, boxes = len(surfaces.condition), len(surfaces.garment), len(surfaces.cell)
    limits = {"surface": kinds, "cell": K, "garment": kinds, "printed": prints, "box": boxes}
    limits |= {"face": K, "skirt": kinds, "between": K, "paired": kinds}
    for name, count in limits.items():
        numbers = getattr(surfaces, name)
        if bool((numbers < 0).any()) or bool((numbers >= count).any()):
            raise ValueError(f"{name} has numbers that are not from 0 to {count - 1}")
    for name, largest in {**LARGEST, "skin": 1.0, "size": LARGEST_SIZE}.items():
        values = getattr(surfaces, name)
        if bool((values < 0).any()) or bool((values > largest).any()):
            raise ValueError(f"{name} has values that are not from 0 to {largest:g}")


def _check_values(prior: PersonPrior, shapes: ShapePrior) -> None:
    variances = ("rest_variance", "variance", "left", "head_variance", "head_left")
    for name, values in [*((name, getattr(prior, name)) for name in variances), ("limit", shapes.limit)]:
        if bool((values < 0).any()):
            raise ValueError(f"{name} has negative values")
    if bool((shapes.limit > LARGEST_BETA).any()):
        raise ValueError(f"body shapes may have betas over {LARGEST_BETA:g}")
    for name, rows in (("basis", prior.basis), ("axes", prior.axes), ("head_axes", prior.head_axes)):
        if bool((rows.abs() > LARGEST_ENTRY).any()):
            raise ValueError(f"{name} has rows longer than 1")


CERTAIN = 0.95
"""Smallest probability of a value that counts as shown."""


def unfollowed(model: DiffusionModel, x0: Float[Tensor, "b c h w"], attributes: Attributes) -> list[dict[str, str]]:
    """Return the categories that each clean sample does not show as asked: name -> the value that it shows instead.

    Empty for a model without a person prior. Height and weight are set on the body, so they are never among them.
    """
    categories, prior = model.vocabulary.categories, getattr(model.denoiser, "prior", None)
    asked = {name: attributes[name] for name in categories if name in attributes}
    if not asked or not isinstance(prior, PersonPrior) or not prior.kind.shape[-1]:
        return [{} for _ in x0]
    blocks = model.vocabulary.blocks()
    found = []
    for probability in prior.expected_kind(prior.split(x0)[0]).cpu():
        shown = {name: probability[blocks[name]].max(0) for name in asked}
        values = {name: categories[name][int(best.indices)] for name, best in shown.items() if best.values > CERTAIN}
        found.append({name: value for name, value in values.items() if value != asked[name]})
    return found


def warnings_of(made: Mapping[str, Any]) -> list[str]:
    """Return a sentence on the attributes that a human does not show; none if it shows all.

    `made` is its provenance, or that of an edit: `unfollowed` beside the `attributes` that were asked for.
    """
    missed = made.get("unfollowed", {})
    if not missed:
        return []
    named = ", ".join(f"{name} {made['attributes'][name]!r} ({shown!r} instead)" for name, shown in missed.items())
    return [
        f"the human does not show {named}: few humans or none of the training set are all that was asked for; leave "
        "some attributes open, or try another seed"
    ]
