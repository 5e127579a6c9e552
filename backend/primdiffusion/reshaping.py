"""The same person on another body: where their primitives go, and how large they are there.

A person's payload belongs to the body they were generated with: half extents are constants of the layout times the
person's own delta scale (paper sec. 3.1), whatever the betas. Give that payload to a body whose surface is stretched
and boxes of the same size lie farther apart: gaps, and patterns seen twice. So a box grows along T and B with a share
of the stretch of its cell of the UV grid. The whole stretch would do for a flat surface; on a round one the corners of
a box stand off the body the farther the wider it is. `benchmarks/reshape_boxes.py` compares shares.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyModel
from primdiffusion.human import Human, body_of
from primdiffusion.primitives.anchors import Anchors, tangent_plane

SHARE = 0.5
"""Exponent of the stretch: 0 leaves boxes alone, 1 lets them grow as much as the surface."""
SAME_BETAS = 1e-5
"""Betas that differ by less are the same body."""


def reshaped(
    human: Human, betas: Float[Tensor, "n"], body: BodyModel | None = None, anchors: Anchors | None = None
) -> Human:
    """The person with other shape coefficients; boxes grow by `box_growth`, in their delta scale. Density stays.

    With the betas they have it is the person themselves, bit for bit. `body` and `anchors` as of `place`. Raises
    ValueError for another number of betas than the person has, or values that are not finite.
    """
    if betas.shape != human.betas.shape:
        raise ValueError(f"{len(betas)} betas were given for a body of {len(human.betas)}: give as many")
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
    """Factors on half extents along T, B, N when a body gets other betas: stretch of the cell at rest ** SHARE; N 1.

    Clothes stay as thick as they are. A product over reshapings is that of the last body and the first.
    """
    sides = [cell_sides(anchors, body.shape(betas).vertices) for betas in (before, after)]
    stretch = sides[1] / sides[0].clamp_min(torch.finfo(sides[0].dtype).tiny)
    return torch.cat([stretch**SHARE, torch.ones_like(stretch[..., :1])], -1)


def cell_sides(anchors: Anchors, vertices: Float[Tensor, "v 3"]) -> Float[Tensor, "k 2"]:
    """How long cells of the UV grid are along T, and how wide along B = N x T, metres."""
    du, dv = tangent_plane(anchors, vertices)
    length = du.norm(dim=-1)
    area = torch.linalg.cross(du, dv).norm(dim=-1)
    return torch.stack([length, area / length.clamp_min(torch.finfo(length.dtype).tiny)], -1)
