"""Regressions on few people: what cells of a person have to do with the skin.

Few people make much of what they happen to share. A cell has many values, which tell more surely than single ones
whether it shows an effect.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.gaussian import PersonComponents

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
