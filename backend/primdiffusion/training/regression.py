"""Regressions on few people: what cells of a person have to do with the skin or with hair.

Few people make much of what they happen to share. A cell has many values, which tell more surely than single ones
whether it shows an effect.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.components import PersonComponents

RIDGE = 4.0
"""People without any effect that every effect is estimated with."""


def regress_cells(
    c: Float[Tensor, "n o"], design: Float[Tensor, "n q"], inside: PersonComponents
) -> tuple[Float[Tensor, "q o"], Float[Tensor, "q o"]]:
    """Regression on a design whose columns have variance 1, with each cell's part shrunk by s = 1 - 1/F (James and
    Stein), down to 0; and what to take away from the coefficients.

    F compares what the design explains in the cell with what it would explain by chance. A cell has one for all its
    values: a colour shows in all of them together, not in single coefficients. Of the shrunk part as much is taken away
    as keeps the variance, if what is left is independent of it.
    """
    freedoms = design.shape[1]
    normal = design.T @ design + RIDGE * torch.eye(freedoms)
    explains = 1 + RIDGE / len(c)  # covariance of the people with what is fitted over the variance of this
    shown, away = [], []
    for basis, part in zip(inside.bases(), c.split(len(inside.basis), dim=1), strict=False):  # the last may be absent
        drawn = torch.einsum("bn,nkd->bkd", part, basis)
        fitted = torch.linalg.solve(normal, design.T @ drawn.flatten(1)).unflatten(1, drawn.shape[1:])
        explained = torch.einsum("bq,qkd->bkd", design, fitted)
        chance = (drawn - explained).square().sum((0, 2)) * freedoms / max(len(c) - freedoms, 1)
        known = (1 - chance / explained.square().sum((0, 2)).clamp_min(1e-12)).clamp_min(0)
        known = known * (len(c) > freedoms)  # so few people are explained by any design
        for found, share in ((shown, known), (away, explains - (explains**2 - known**2).sqrt())):
            found.append(torch.einsum("qkd,k,nkd->qn", fitted, share, basis))
    return torch.cat(shown, dim=1), torch.cat(away, dim=1)


def principal_directions(c: Float[Tensor, "n i"], count: int) -> tuple[Float[Tensor, "q"], Float[Tensor, "i q"]]:
    """Standard deviations along the leading principal directions, and these as columns."""
    value, vector = torch.linalg.eigh((c.T @ c).double() / len(c))
    return value.flip(0)[:count].clamp_min(1e-12).sqrt().float(), vector.flip(1)[:, :count].float()
