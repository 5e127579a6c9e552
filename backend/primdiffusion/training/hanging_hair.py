"""Hair that hangs over clothes, found by comparing its people with those whose clothes are bare.

In cells below hair the clothes do not show their own colour, but that of the hair, which is the head's. Without this
the colour of hair would be one of the clothes: locks at the neck of people with short hair, in any colour.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.components import PersonComponents
from primdiffusion.training.regression import principal_directions, regress_cells

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
