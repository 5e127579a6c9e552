"""Find prints: patterns in two colours that several people have at the same place of a garment.

What a printed garment differs by from its mean colour is one pattern times one difference of colours, so it is the
leading direction of its voxels' colours. People whose patterns are alike have the same print.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from primdiffusion.primitives.primitives import S

ALIKE = 0.65
"""Least cosine of the patterns of two people who have the same print."""
STRONG = 0.04
"""Least rms difference from a garment's mean colour: less is light and folds."""
FEWEST_GEOMETRIES = 4
"""With fewer people chance looks like a surface, or a print."""
CLEAR = 0.02
"""Share of voxels that are wholly in the first colour, and in the second."""
OWN_SHARE = 0.5
"""Least share of the garment by which a voxel's colour is divided: others show too much of what is beside it."""
UNSEEN = 0.01
"""Voxels that count less, and whose neighbours do, are noise, which would be stored."""
FAINT = 0.03
"""Boxes with less of the second colour are left out."""


class Print(NamedTuple):
    """A print on m of a garment's boxes."""

    box: Int[Tensor, "m"]
    """Places among the garment's boxes."""
    second: Float[Tensor, "m 512"]
    """Share of a voxel's colour that is the second one."""


def find_prints(
    colours: Float[Tensor, "n r 512 3"],
    weight: Float[Tensor, "r 512"],
    share: Float[Tensor, "r 512"],
    whole: Bool[Tensor, "r"],
    geometry: Int[Tensor, "n"],
) -> list[Print]:
    """Prints of a garment with r boxes that enough people have; the most common one first.

    `colours` are those of its voxels on each of n people, over the garment's tones, and `weight` how much a voxel
    counts. `share` of each voxel is the garment; prints are found in `whole` boxes and continued in the others.
    `geometry` tells people from further colourings of them.
    """
    counted = (weight * whole[:, None]).flatten()
    counted = counted / counted.sum().clamp_min(1e-6)
    flat = colours.flatten(1, 2)
    differences = flat - torch.einsum("v,nvc->nc", counted, flat)[:, None]
    centred = differences * counted.sqrt()[:, None]
    strong = (centred.square().sum((1, 2)) / 3).sqrt() > STRONG
    differences, centred, geometry = differences[strong], centred[strong], geometry[strong]
    if not len(centred):
        return []
    patterns = torch.stack([_leading(one.T) for one in centred])
    alike = (patterns @ patterns.T).abs() > ALIKE
    left, prints = torch.ones(len(alike), dtype=torch.bool), []
    while (counts := (alike & left).sum(1) * left).any():
        same = alike[counts.argmax()] & left
        left &= ~same
        if len(geometry[same].unique()) >= FEWEST_GEOMETRIES:
            scores = torch.einsum("v,nvc->nc", _leading(centred[same].mT.flatten(0, 1)), centred[same])
            value = torch.einsum("nc,nvc->v", scores, differences[same]) / scores.square().sum().clamp_min(1e-12)
            prints.append(_print(value / share.flatten().clamp_min(OWN_SHARE), counted, weight))
    return prints


def _leading(rows: Float[Tensor, "m v"]) -> Float[Tensor, "v"]:
    """The leading direction of rows, of length 1."""
    vector = torch.linalg.eigh(rows @ rows.T)[1][:, -1] @ rows
    return vector / vector.norm().clamp_min(1e-12)


def _print(value: Float[Tensor, "v"], counted: Float[Tensor, "v"], weight: Float[Tensor, "r 512"]) -> Print:
    """Shares of the second colour, which is that of fewer voxels."""
    order = value.argsort()
    before = counted[order].cumsum(0)
    first, second = (
        value[order[torch.searchsorted(before, at).clamp_max(len(order) - 1)]] for at in (CLEAR, 1 - CLEAR)
    )
    mixed = ((value - first) / (second - first).clamp_min(1e-6)).clamp(0, 1)
    if (mixed * counted).sum() > 0.5:
        mixed = 1 - mixed
    counts = functional.max_pool3d(weight.view(-1, 1, S, S, S), 3, stride=1, padding=1) > UNSEEN
    mixed = mixed.view_as(weight) * counts.view_as(weight)
    shown = (mixed * weight).sum(1) > FAINT * weight.sum(1)
    return Print(shown.nonzero()[:, 0], mixed[shown])
