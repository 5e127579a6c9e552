"""Larger boxes for skirts: between the legs is cloth, which boxes of the usual size do not reach in the rest pose.

Box sizes are a part of the representation (`Payload.delta_scale`), and these depend on the outfit alone, so that all
people in one learn from each other.
"""

from __future__ import annotations

import functools

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import default_body
from primdiffusion.primitives.anchors import attach, default_anchors

HEMS = {"blouse and skirt": -0.53, "blouse and long skirt": -0.75}
"""Heights of the lowest boxes behind a skirt, on the default body, metres."""
WAIST = -0.1
"""Boxes between it and the hem are on hips and legs: hands are above, in the T pose."""
FACING = 0.3
"""Least part of a box's normal that points from one leg to the other."""
MARGIN, LARGEST = 1.1, 2.2
"""Reach beyond the middle, for legs that are further apart, and the largest size: voxels of large boxes are coarse."""


@functools.lru_cache(maxsize=len(HEMS))
def box_sizes(outfit: str) -> Float[Tensor, "k 3"] | None:
    """`delta_scale` of people in an outfit (as `wardrobe.attribute_labels`); None without a skirt.

    Boxes on the insides of the legs are longer along the axis that brings them to the middle with the least change.
    """
    if outfit not in HEMS:
        return None
    body = default_body()
    frames = attach(default_anchors(), body.template, body.faces)
    across = frames.position[:, 0]
    inside = frames.rotation[:, 0, 2] * across.sign() < -FACING
    inside &= (frames.position[:, 1] > HEMS[outfit]) & (frames.position[:, 1] < WAIST)
    reach = frames.rotation[:, 0].abs() * frames.half_extent
    axis = reach.argmax(1)
    needed = MARGIN * across.abs() / reach.amax(1)
    sizes = torch.ones_like(frames.half_extent)
    sizes[inside, axis[inside]] = needed[inside].clamp(1, LARGEST)
    return sizes
