"""Regressions of the colours of voxels and boxes on those of surfaces, with one slope for red, green and blue."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from primdiffusion.diffusion.surfaces import BRIGHTEST, density_weight, seen
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
BESIDE = 0.1, 0.001
"""Weights of a voxel's column, from the body outwards, and of its box in what is known of the voxel."""
RIDGE = 1e-5
"""Added to sums of squares of colours, so that equations have a solution in boxes that are empty on everybody."""
FEWEST_BOXES = 24
"""Fewest boxes of a garment, or of skin: socks and collars are too few to tell from chance."""


class Meeting(NamedTuple):
    """Sums over people of voxels where surfaces meet, as mixtures of the colours of Q surfaces, by their density."""

    normal: Float[Tensor, "k 512 q q"]
    by_design: Float[Tensor, "k 512 q"]
    total: Float[Tensor, "k 512 3"]
    square: Float[Tensor, "k 512"]
    weight: Float[Tensor, "k 512"]
    seen: Float[Tensor, "k 512"]

    @classmethod
    def of(
        cls,
        colours: Sequence[Float[Tensor, "n 3"]],
        people: Iterator[Float[Tensor, "m 1024 512 4"]],
        cells: Bool[Tensor, "k"],
    ) -> Meeting:
        parts = []
        for x, voxels in zip(torch.stack(list(colours), dim=-1).split(CHUNK), people, strict=True):
            weight, rgb = density_weight(voxels[:, cells]), voxels[:, cells, :, :3]
            weighted = weight[..., None] * rgb
            normal = torch.einsum("nkv,nqr->kvqr", weight, x.mT @ x)
            by_design = torch.einsum("nkvc,ncq->kvq", weighted, x)
            square = (weighted * rgb).sum((0, 3))
            parts.append((normal, by_design, weighted.sum(0), square, weight.sum(0), seen(voxels[:, cells]).sum(0)))
        return cls(*(torch.stack(each).sum(0) for each in zip(*parts, strict=True)))

    def fitted(self) -> tuple[Float[Tensor, "k 512 q"], Float[Tensor, "k 512"]]:
        """Share of each surface in a voxel, and the voxel's tone."""
        normal, by_design = spread(self.normal), spread(self.by_design)
        ridge = RIDGE * torch.eye(normal.shape[-1])
        slopes = torch.linalg.solve(normal + ridge, by_design[..., None])[..., 0].clamp_min(0)
        shares = slopes / slopes.sum(-1, keepdim=True).clamp_min(1e-6)
        along, power = _products(by_design, normal, shares)
        return shares, (along / power.clamp_min(1e-6)).clamp(0, BRIGHTEST)

    def tested(self, other: Meeting) -> tuple[Float[Tensor, "k"], Float[Tensor, "k"]]:
        """Mean squares over each box of what the fit to others leaves, and of differences between people."""
        shares, tone = other.fitted()
        along, power = _products(self.by_design, self.normal, shares)
        error = self.square - 2 * tone * along + tone.square() * power
        differences = self.square - self.total.square().sum(-1) / self.weight.clamp_min(1e-6)
        counted = self.seen / self.weight.clamp_min(1e-6) / (3 * self.seen.sum(1, keepdim=True).clamp_min(1e-6))
        return (error * counted).sum(1), (differences * counted).sum(1)


def _products(
    by_design: Float[Tensor, "k 512 q"], normal: Float[Tensor, "k 512 q q"], shares: Float[Tensor, "k 512 q"]
) -> tuple[Float[Tensor, "k 512"], Float[Tensor, "k 512"]]:
    """Products of mixtures with the voxels, and with themselves."""
    return (shares * by_design).sum(-1), torch.einsum("kvq,kvqr,kvr->kv", shares, normal, shares)


def spread(sums: Float[Tensor, "k 512 *d"]) -> Float[Tensor, "k 512 *d"]:
    """Sums over people with a little of those of the voxel's column and of its box: a voxel that is empty on nearly
    everybody, but not on a sample, looks like what is beside it."""
    of_column, of_box = BESIDE
    column = sums.unflatten(1, (S, S**2)).mean(1, keepdim=True).expand(-1, S, -1, *sums.shape[2:])
    return sums + of_column * column.flatten(1, 2) + of_box * sums.mean(1, keepdim=True)


def mean_colour(voxels: Float[Tensor, "*b v 4"], weight: Float[Tensor, "*b v"]) -> Float[Tensor, "*b 3"]:
    """Mean colour of voxels."""
    total = (voxels[..., :3] * weight[..., None]).sum(-2)
    return total / weight.sum(-1, keepdim=True).clamp_min(1e-6)


def normal_equations(colours: Sequence[Float[Tensor, "n 3"]]) -> tuple[Float[Tensor, "q q"], Float[Tensor, "n 3 q"]]:
    """The normal matrix of a regression on differences of colours from their means, with the same slope for red, green
    and blue, and its design."""
    design = torch.stack([colour - colour.mean(0) for colour in colours], dim=-1)
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
