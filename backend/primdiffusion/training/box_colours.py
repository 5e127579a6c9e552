"""Regressions of the colours of voxels and boxes on those of surfaces, with one slope for red, green and blue."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from primdiffusion.diffusion.surfaces import BRIGHTEST, seen
from primdiffusion.primitives.primitives import GRID, S

PASSES = 3
"""Regressions, each on the colour of what the former found."""
CHUNK = 16
"""People whose voxels are in memory at once."""
DARKEST = 0.5
"""Tones below this count as this: chance is large beside a dark voxel's colour."""
COVERED, OTHERS = 0.85, 0.3
"""Least slope of a box's colour on the surface's, as a share of its tone, and largest slopes on other colours."""
UNEVEN = 0.04
"""Largest rms difference between a box's colour and its tone of the surface's."""
SURROUNDED = 0.7
"""Share of a box and its neighbours that a garment covers, above which the box is the garment's too."""
FEWEST_BOXES = 24
"""Fewest boxes of a garment, or of skin: socks and collars are too few to tell from chance."""


class Meeting(NamedTuple):
    """Sums over people of boxes where surfaces meet: voxels, their colours as mixtures of those of Q surfaces."""

    normal: Float[Tensor, "q q"]
    by_design: Float[Tensor, "k 512 q"]
    total: Float[Tensor, "k 512 3"]
    square: Float[Tensor, "k 512"]
    seen: Float[Tensor, "k 512"]
    people: Int[Tensor, ""]

    @classmethod
    def of(
        cls,
        colours: Sequence[Float[Tensor, "n 3"]],
        people: Iterator[Float[Tensor, "m 1024 512 4"]],
        cells: Bool[Tensor, "k"],
    ) -> Meeting:
        normal, design = normal_equations(colours, centred=False)
        parts = []
        for x, voxels in zip(design.split(CHUNK), people, strict=True):
            rgb = voxels[:, cells, :, :3]
            by_design = torch.einsum("ncq,nkvc->kvq", x, rgb)
            parts.append((by_design, rgb.sum(0), rgb.square().sum((0, 3)), seen(voxels[:, cells]).sum(0)))
        by_design, total, square, weight = (torch.stack(each).sum(0) for each in zip(*parts, strict=True))
        return cls(normal, by_design, total, square, weight, torch.tensor(len(design)))

    def fitted(self) -> tuple[Float[Tensor, "k 512 q"], Float[Tensor, "k 512"]]:
        """Share of each surface in a voxel, and the voxel's tone."""
        slopes = torch.linalg.solve(self.normal, self.by_design[..., None])[..., 0].clamp_min(0)
        shares = slopes / slopes.sum(-1, keepdim=True).clamp_min(1e-6)
        along, power = self._products(shares)
        return shares, (along / power).clamp(0, BRIGHTEST)

    def tested(self, other: Meeting) -> tuple[Float[Tensor, "k"], Float[Tensor, "k"]]:
        """Mean squares over each box of what the fit to others leaves, and of differences between people."""
        shares, tone = other.fitted()
        along, power = self._products(shares)
        error = self.square - 2 * tone * along + tone.square() * power
        spread = self.square - self.total.square().sum(-1) / self.people
        weight = self.seen / (3 * self.people * self.seen.sum(1, keepdim=True).clamp_min(1e-6))
        return (error * weight).sum(1), (spread * weight).sum(1)

    def _products(self, shares: Float[Tensor, "k 512 q"]) -> tuple[Float[Tensor, "k 512"], Float[Tensor, "k 512"]]:
        """Products of mixtures with the voxels, and with themselves."""
        power = torch.einsum("kvq,qr,kvr->kv", shares, self.normal, shares)
        return (shares * self.by_design).sum(-1), power.clamp_min(1e-6)


def mean_colour(voxels: Float[Tensor, "*b v 4"], weight: Float[Tensor, "*b v"]) -> Float[Tensor, "*b 3"]:
    """Mean colour of voxels."""
    total = (voxels[..., :3] * weight[..., None]).sum(-2)
    return total / weight.sum(-1, keepdim=True).clamp_min(1e-6)


def normal_equations(
    colours: Sequence[Float[Tensor, "n 3"]], centred: bool = True
) -> tuple[Float[Tensor, "q q"], Float[Tensor, "n 3 q"]]:
    """The normal matrix of a regression on colours, with the same slope for red, green and blue, and its design."""
    design = torch.stack([colour - colour.mean(0) if centred else colour for colour in colours], dim=-1)
    return torch.einsum("ncq,ncr->qr", design, design) + 1e-2 * torch.eye(len(colours)), design


def _slopes(values: Float[Tensor, "n k 3"], colours: Sequence[Float[Tensor, "n 3"]]) -> Float[Tensor, "k q"]:
    normal, design = normal_equations(colours)
    return torch.linalg.solve(normal, torch.einsum("ncq,nkc->kq", design, values)[..., None])[..., 0]


def tones_of(boxes: Float[Tensor, "n k 3"], part: Bool[Tensor, "k"]) -> tuple[Float[Tensor, "k"], Float[Tensor, "k"]]:
    """Tones of boxes of a part's colour, and rms differences from them."""
    colour = boxes[:, part].mean(1)
    tone = torch.einsum("nc,nkc->k", colour, boxes) / colour.square().sum().clamp_min(1e-6)
    return tone, (boxes - tone[:, None] * colour[:, None]).square().mean((0, 2)).sqrt()


def covered_by(
    boxes: Float[Tensor, "n k 3"],
    start: Bool[Tensor, "k"],
    others: Sequence[Float[Tensor, "n 3"]],
    within: Bool[Tensor, "k"],
) -> Bool[Tensor, "k"] | None:
    """The boxes `within` that follow the colour of those of the start, and no other; None if they are few."""
    covered = start
    for _ in range(PASSES):
        tone, uneven = tones_of(boxes, covered)
        slope, by_others = _slopes(boxes, [boxes[:, covered].mean(1), *others]).split([1, len(others)], dim=-1)
        covered = (slope[:, 0] / tone.clamp(DARKEST, 1 / DARKEST) > COVERED) & (uneven < UNEVEN) & within
        covered &= (by_others.abs() < OTHERS).all(-1)
        if covered.sum() < FEWEST_BOXES:
            return None
    return covered


def surrounded(part: Bool[Tensor, "k"]) -> Bool[Tensor, "k"]:
    """Boxes nearly all of whose neighbours on the grid are in the part: holes, where a few people wear a badge."""
    around = functional.avg_pool2d(part.float().view(1, GRID, GRID), 3, stride=1, padding=1)
    return around.flatten() > SURROUNDED


def largest_part(boxes: Float[Tensor, "n k 3"], left: Bool[Tensor, "k"]) -> Bool[Tensor, "k"] | None:
    """The most boxes among those left that have the tones of one of them; None if they are few."""
    of_boxes = boxes[:, left].transpose(0, 1).flatten(1)
    products = of_boxes @ of_boxes.T
    tone = products / products.diagonal().clamp_min(1e-6)
    uneven = ((products.diagonal()[:, None] - tone * products).clamp_min(0) / of_boxes.shape[1]).sqrt()
    alike = (uneven < UNEVEN) & (tone > DARKEST) & (tone < 1 / DARKEST)
    if not len(alike) or alike.sum(0).max() < FEWEST_BOXES:
        return None
    return torch.zeros_like(left).masked_scatter(left, alike[:, alike.sum(0).argmax()])


def unexplained_share(colour: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]) -> float:
    """Share of a colour's variance that another one does not explain."""
    centred, design = colour - colour.mean(0), other - other.mean(0)
    slope = (centred * design).sum() / design.square().sum().clamp_min(1e-6)
    return float((centred - slope * design).square().sum() / centred.square().sum().clamp_min(1e-6))


def smooth(values: Float[Tensor, "c 512"]) -> Float[Tensor, "c 512"]:
    """Means over neighbouring voxels of each box: the slope of one voxel is noisy."""
    boxes = functional.pad(values.view(-1, 1, S, S, S), (1,) * 6, mode="replicate")
    return functional.avg_pool3d(boxes, 3, stride=1).view_as(values)
