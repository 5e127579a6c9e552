"""Regressions on few people: what cells of a person have to do with the skin or with hair that hangs over clothes.

Few people make much of what they happen to share. A cell has many values, which tell more surely than single ones
whether it shows an effect.

In cells below hair the clothes do not show their own colour, but that of the hair, which is the head's. Without this
the colour of hair would be one of the clothes: locks at the neck of people with short hair, in any colour.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.components import PersonComponents

RIDGE = 4.0
"""People without any effect that every effect is estimated with."""


def regress_cells(
    c: Float[Tensor, "n o"], design: Float[Tensor, "n q"], inside: PersonComponents
) -> tuple[Float[Tensor, "q o"], Float[Tensor, "n o"]]:
    """Coefficients of a regression on a design whose columns have variance 1, each cell's part shrunk by
    s = 1 - 1/F (James and Stein), down to 0; and what is left of c without as much of each cell's part.

    F compares what the design explains in the cell with what it would explain by chance. A cell has one for all its
    values: a colour shows in all of them together, not in single coefficients.
    """
    people, freedoms = design.shape
    if people <= freedoms:  # so few people are explained by any design
        return c.new_zeros(freedoms, c.shape[1]), c
    explained = design @ torch.linalg.lstsq(design, c).solution
    # The ridge is for columns that hardly vary among these people; the others are not to shrink with them.
    normal = design.T @ design + RIDGE * torch.eye(freedoms)
    effect = (1 + RIDGE / people) * torch.linalg.solve(normal, design.T @ c)
    parts = (each.split(len(inside.basis), dim=1) for each in (effect, explained, c - explained))
    shown, known = [], []
    for basis, *of_part in zip(inside.bases(), *parts, strict=False):  # the last parts may be absent
        fitted, found, missed = (torch.einsum("bn,nkd->bkd", each, basis) for each in of_part)
        chance = missed.square().sum((0, 2)) * freedoms / (people - freedoms)
        s = (1 - chance / found.square().sum((0, 2)).clamp_min(1e-12)).clamp_min(0)
        shown.append(torch.einsum("qkd,k,nkd->qn", fitted, s, basis))
        known.append(torch.einsum("bkd,k,nkd->bn", found, s, basis))
    return torch.cat(shown, dim=1), c - torch.cat(known, dim=1)


def principal_directions(c: Float[Tensor, "n i"], count: int) -> tuple[Float[Tensor, "q"], Float[Tensor, "i q"]]:
    """Standard deviations along the leading principal directions, and these as columns."""
    value, vector = torch.linalg.eigh((c.T @ c).double() / len(c))
    return value.flip(0)[:count].clamp_min(1e-12).sqrt().float(), vector.flip(1)[:, :count].float()


COLOURS = 8
"""Principal directions of bare clothes in which their colour is looked for."""


class HangingHair(NamedTuple):
    """A style of hair that hangs over clothes."""

    through: Float[Tensor, "o o"]
    """What coefficients of clothes (rows) become where the hair covers them."""
    of_clothes: Float[Tensor, "q o"]
    """Directions of the hair's colour in the cells of the clothes, as long as their standard deviations."""
    of_head: Float[Tensor, "q s"]
    """The same in the head."""


def find_hanging_hair(
    bare: Float[Tensor, "m o"], own: Float[Tensor, "n r"], inside: PersonComponents, directions: int
) -> tuple[HangingHair, Float[Tensor, "n s"]]:
    """One style of hair, and what its colour leaves of its people's heads.

    Args:
        bare: coefficients of people with bare clothes, without their means.
        own: the same of people with the hair, with head.
        inside: the components; the leading o coefficients are those of clothes.
        directions: q, number of directions of the hair's colour.
    """
    clothes = bare.shape[1]
    deviation, colour = principal_directions(bare, min(COLOURS, clothes // 2))
    scores = own[:, :clothes] @ colour
    seen = (scores.square().mean(0).sqrt() / deviation).clamp_max(1)  # less of a colour that is covered in part
    first = (own.shape[1] + clothes) // 2  # hands have no hair
    of_hair, hair = principal_directions(own[:, first:], directions)
    tones = own[:, first:] @ hair / of_hair
    design = torch.cat([scores / deviation, tones], dim=1)
    change, _ = regress_cells(own[:, :clothes] - scores @ colour.T, design, inside)
    of_head = tones.T @ own[:, clothes:] / len(own)
    becomes = colour.T * seen[:, None] + (seen / deviation)[:, None] * change[: len(seen)]
    through = torch.eye(clothes) + colour @ (becomes - colour.T)
    return HangingHair(through, change[len(seen) :], of_head), own[:, clothes:] - tones @ of_head
