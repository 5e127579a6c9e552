"""Change a human's body shape: give its payload other betas and resize the primitives.

A payload fits the body it was generated with: half extents are constants of the layout times the payload's delta scale
(paper sec. 3.1), independent of betas. On a stretched surface, boxes of the same size lie farther apart, which shows as
gaps and repeated patterns. So a box grows along T and B by a power of the stretch of its cell of the UV grid. The full
stretch would suit a flat surface; on a curved one, the corners of wider boxes stand off the body.
`benchmarks/reshape.py boxes` compares exponents.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyModel
from primdiffusion.human import Human, body_of
from primdiffusion.primitives.anchors import Anchors, cell_sides

SHARE = 0.5
"""Exponent of the stretch: 0 keeps box sizes, 1 scales boxes with the surface."""
SAME_BETAS = 1e-5
"""Tolerance within which betas count as equal."""


def reshape_human(
    human: Human, betas: Float[Tensor, "n"], body: BodyModel | None = None, anchors: Anchors | None = None
) -> Human:
    """Return the human with other betas, its delta scales multiplied by `box_growth`; density is unchanged.

    Unchanged betas return `human` itself. `body` and `anchors` are those of `place`. Raises ValueError for a wrong
    number of betas or values that are not finite.
    """
    if betas.shape != human.betas.shape:
        raise ValueError(f"got {len(betas)} betas for a body with {len(human.betas)}: give {len(human.betas)}")
    betas = betas.to(human.betas)
    if torch.allclose(betas, human.betas, rtol=0, atol=SAME_BETAS):
        return human
    body, anchors = body_of(human, body, anchors)
    payload = human.payload
    growth = box_growth(body, anchors, human.betas, betas)
    payload = dataclasses.replace(payload, delta_scale=payload.delta_scale * growth.to(payload.delta_scale))
    return dataclasses.replace(human, betas=betas, payload=payload).validate()


def box_growth(
    body: BodyModel, anchors: Anchors, before: Float[Tensor, "n"], after: Float[Tensor, "n"]
) -> Float[Tensor, "k 3"]:
    """Factors on half extents along T, B, N when betas change: the rest cell's stretch ** SHARE; 1 along N.

    The thickness of clothes is unchanged. Factors of successive changes multiply to that of the whole change.
    """
    sides = [cell_sides(anchors, body.shape(betas).vertices) for betas in (before, after)]
    stretch = sides[1] / sides[0].clamp_min(torch.finfo(sides[0].dtype).tiny)
    return torch.cat([stretch**SHARE, torch.ones_like(stretch[..., :1])], -1)
