"""Find surfaces of one colour: boxes and voxels whose colours follow that of a surface on all people who have it.

Hair, garments and skin are found by regressions on the colour of the surface, first that of a region, then that of what
was found, and on colours that it may go with: dark hair often goes with dark skin. Hair is found in voxels, as it hangs
over clothes; plain garments and skin in boxes, which they cover from border to border.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.surfaces import BRIGHTEST, SURELY, Surfaces, seen, voxels_of
from primdiffusion.editing.regions import region_of
from primdiffusion.primitives.primitives import S
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import LatentSet

FEWEST_GEOMETRIES = 4
"""With fewer people chance looks like a surface."""
PASSES = 3
"""Regressions, each on the colour of what the former found."""
CHUNK = 16
"""People whose voxels are in memory at once."""
NO_HAIR, ALL_HAIR = 0.4, 0.8
"""Slopes of a voxel's colour on the hair's, as shares of its tone: below is no hair, above all of it is."""
DARKEST = 0.5
"""Tones below this count as this: chance is large beside a dark voxel's colour."""
FEWEST_VOXELS, SOLID = 8, 0.3
"""Voxels of hair, as dense as that, in a box; fewer are chance."""
BALD = 0.3
"""Share of the variance of hair that is not the skin's; with less the head is bald."""
COVERED, OTHERS = 0.85, 0.3
"""Least slope of a box's colour on the surface's, as a share of its tone, and largest slopes on other colours."""
UNEVEN = 0.04
"""Largest rms difference between a box's colour and its tone of the surface's."""
UNEVEN_GARMENT = 0.0125
"""The same in the median over a garment's boxes: more are prints and fades, which plain garments may have too."""
FEWEST_BOXES = 8
"""Of a garment, or of skin."""


class _Rows(NamedTuple):
    """Boxes of one surface, as fields of `Surfaces`."""

    cell: Int[Tensor, "n"]
    share: Float[Tensor, "n 512"]
    tone: Float[Tensor, "n 512"]
    read: Bool[Tensor, "n"]
    drawn: Bool[Tensor, "n"]


def fit_surfaces(
    people: LatentSet, codec: LinearCodec, vocabulary: AttributeVocabulary, config: PriorConfig
) -> Surfaces | None:
    """Skin and plain garments of each outfit and each style of hair, of detailed people; None if nothing is found.

    The people's attributes say who has them: `config.outfit`, `config.hair`, "pattern" (plain) and "hat" (none).
    """
    known = _People(people, codec, vocabulary, config)
    found: list[tuple[Tensor, _Rows]] = []
    for outfit in vocabulary.categories.get(config.outfit, ()):
        worn = {config.outfit: outfit}
        found += known.covering(worn, "hands", ("torso", "hips"), skin=True)
        for region, others in (("torso", ("hands", "hips")), ("hips", ("hands", "torso"))):
            found += known.covering({**worn, **known.only("pattern", "plain")}, region, others)
    for hair in vocabulary.categories.get(config.hair, ()):
        found += known.hair({config.hair: hair, **known.only("hat", "none")}, hair in config.hanging)
    if not found:
        return None
    conditions, rows = zip(*found, strict=True)
    surface = torch.cat([torch.full((len(each.cell),), number) for number, each in enumerate(rows)])
    return Surfaces(torch.stack(conditions), surface, *(torch.cat(each) for each in zip(*rows, strict=True)))


class _People:
    """Detailed people, with the mean colours of their boxes."""

    def __init__(
        self, people: LatentSet, codec: LinearCodec, vocabulary: AttributeVocabulary, config: PriorConfig
    ) -> None:
        count = int(people.detailed)
        self.latents, self.codec, self.vocabulary = people.latents[:count], codec, vocabulary
        self.condition, self.geometry = people.condition[:count], people.geometry[:count]
        self.hanging = torch.zeros(count, dtype=torch.bool)
        for hair in vocabulary.categories.get(config.hair, ()):
            if hair in config.hanging:
                self.hanging |= self.condition @ vocabulary.encode({config.hair: hair}) > 0
        self.boxes = torch.cat([_mean(voxels, seen(voxels)) for voxels in self.voxels(torch.arange(count))])

    def only(self, name: str, value: str) -> Mapping[str, str]:
        """The attribute, unless it is unknown."""
        return {name: value} if value in self.vocabulary.categories.get(name, ()) else {}

    def voxels(self, people: Int[Tensor, "n"]) -> Iterator[Float[Tensor, "m 1024 512 4"]]:
        """Voxels of people, some at a time."""
        for some in people.split(CHUNK):
            yield voxels_of(self.codec.decode(self.latents[some].float()))

    def with_all(self, attributes: Mapping[str, str]) -> tuple[Float[Tensor, "a"], Int[Tensor, "n"]]:
        """A condition, and the people of whom it is true; none if they are of few geometries."""
        row = self.vocabulary.encode(attributes)
        own = self.condition @ row >= row.sum()
        few = len(self.geometry[own].unique()) < FEWEST_GEOMETRIES
        return row, (own & (not few)).nonzero()[:, 0]

    def covering(
        self, attributes: Mapping[str, str], region: str, others: Sequence[str], skin: bool = False
    ) -> list[tuple[Tensor, _Rows]]:
        """The surface that a region shows, in all boxes that it covers; skin takes the colour of the face."""
        row, own = self.with_all(attributes)
        own = own[~self.hanging[own]]
        if not len(own):
            return []
        boxes, face = self.boxes[own], region_of(("face",))
        never = region_of(("hair",)) if skin else region_of(("head", "hands"))
        beside = [boxes[:, region_of((name,))].mean(1) for name in others]
        covered = region_of((region,))
        for _ in range(PASSES):
            colour = boxes[:, covered].mean(1)
            slope, by_others = _slopes(boxes, [colour, *beside]).split([1, len(beside)], dim=-1)
            tone = torch.einsum("nc,nkc->k", colour, boxes) / colour.square().sum()
            uneven = (boxes - tone[:, None] * colour[:, None]).square().mean((0, 2)).sqrt()
            covered = (slope[:, 0] / tone.clamp(DARKEST, 1 / DARKEST) > COVERED) & (uneven < UNEVEN) & ~never
            covered &= (by_others.abs() < OTHERS).all(-1)
            if covered.sum() < FEWEST_BOXES:
                return []
        read = covered & face if skin else covered
        if not read.any() or (not skin and float(uneven[covered].median()) > UNEVEN_GARMENT):
            return []
        colour = boxes[:, read].mean(1)
        by_colour = sum(
            torch.einsum("nc,nkvc->kv", some, voxels[:, covered, :, :3])
            for some, voxels in zip(colour.split(CHUNK), self.voxels(own), strict=True)
        )
        tones = (by_colour / colour.square().sum()).clamp(0, BRIGHTEST)
        drawn = ~face if skin else covered
        return [(row, _Rows(covered.nonzero()[:, 0], torch.ones_like(tones), tones, read[covered], drawn[covered]))]

    def hair(self, attributes: Mapping[str, str], hanging: bool) -> list[tuple[Tensor, _Rows]]:
        """The voxels of a style of hair on the head, and on the clothes if it hangs over them."""
        row, own = self.with_all(attributes)
        if not len(own):
            return []
        head, below = region_of(("head",)), region_of(("torso", "hips", "arms"))
        cells = (head | below if hanging else head).nonzero()[:, 0]
        on_head = head[cells]
        skin, colour = (self.boxes[own][:, region_of((name,))].mean(1) for name in ("hands", "hair"))
        if _left_of(colour, skin) < BALD:
            return []
        share = torch.zeros(len(cells), S**3)
        for number in range(PASSES):
            if number:
                sure = (share[on_head] - SURELY).clamp_min(0)
                on_heads = (voxels[:, cells[on_head]] for voxels in self.voxels(own))
                colour = torch.cat([_mean(v.flatten(1, 2), (sure * seen(v)).flatten(1)) for v in on_heads])
            normal, design = _normal([colour, skin])
            by_design, by_colour, density = (torch.zeros(len(cells), S**3, *size) for size in ((2,), (), ()))
            for x, some, voxels in zip(design.split(CHUNK), colour.split(CHUNK), self.voxels(own), strict=True):
                by_design += torch.einsum("ncq,nkvc->kvq", x, voxels[:, cells, :, :3])
                by_colour += torch.einsum("nc,nkvc->kv", some, voxels[:, cells, :, :3])
                density += voxels[:, cells, :, 3].sum(0) / len(own)
            tone = (by_colour / colour.square().sum().clamp_min(1e-6)).clamp(0, BRIGHTEST)
            slope = torch.linalg.solve(normal, by_design[..., None])[..., 0, 0]
            slope = _smooth(slope) / _smooth(tone).clamp(DARKEST, 1)
            share = ((slope - NO_HAIR) / (ALL_HAIR - NO_HAIR)).clamp(0, 1)
            share *= (((share > 0.5) & (density > SOLID)).sum(1) >= FEWEST_VOXELS)[:, None]
            if not share[on_head].any():
                return []
        kept = share.any(1)
        tone = tone * (share > 0)
        return [(row, _Rows(cells[kept], share[kept], tone[kept], on_head[kept], torch.ones_like(on_head[kept])))]


def _mean(voxels: Float[Tensor, "*b v 4"], weight: Float[Tensor, "*b v"]) -> Float[Tensor, "*b 3"]:
    """Mean colour of voxels."""
    total = (voxels[..., :3] * weight[..., None]).sum(-2)
    return total / weight.sum(-1, keepdim=True).clamp_min(1e-6)


def _normal(colours: Sequence[Float[Tensor, "n 3"]]) -> tuple[Float[Tensor, "q q"], Float[Tensor, "n 3 q"]]:
    """The normal matrix of a regression on colours, with the same slope for red, green and blue, and its design."""
    design = torch.stack([colour - colour.mean(0) for colour in colours], dim=-1)
    return torch.einsum("ncq,ncr->qr", design, design) + 1e-2 * torch.eye(len(colours)), design


def _slopes(values: Float[Tensor, "n k 3"], colours: Sequence[Float[Tensor, "n 3"]]) -> Float[Tensor, "k q"]:
    normal, design = _normal(colours)
    return torch.linalg.solve(normal, torch.einsum("ncq,nkc->kq", design, values)[..., None])[..., 0]


def _left_of(colour: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]) -> float:
    """Share of a colour's variance that another one does not explain."""
    centred, design = colour - colour.mean(0), other - other.mean(0)
    slope = (centred * design).sum() / design.square().sum().clamp_min(1e-6)
    return float((centred - slope * design).square().sum() / centred.square().sum().clamp_min(1e-6))


def _smooth(values: Float[Tensor, "c 512"]) -> Float[Tensor, "c 512"]:
    """Means over neighbouring voxels of each box: the slope of one voxel is noisy."""
    boxes = functional.pad(values.view(-1, 1, S, S, S), (1,) * 6, mode="replicate")
    return functional.avg_pool3d(boxes, 3, stride=1).view_as(values)
