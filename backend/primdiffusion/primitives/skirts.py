"""Larger boxes for skirts: between the legs is cloth, which boxes of the usual size do not reach in the rest pose.

Box sizes are a part of the representation (`Payload.delta_scale`), and these depend on the outfit alone, so that all
people in one learn from each other.
"""

from __future__ import annotations

import functools

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from primdiffusion.body.model import default_body
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.primitives import Frames, S

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
    frames = _frames()
    inside = inside_legs() & (frames.position[:, 1] > HEMS[outfit])
    reach = frames.rotation[:, 0].abs() * frames.half_extent
    axis = reach.argmax(1)
    needed = MARGIN * frames.position[:, 0].abs() / reach.amax(1)
    sizes = torch.ones_like(frames.half_extent)
    sizes[inside, axis[inside]] = needed[inside].clamp(1, LARGEST)
    return sizes


@functools.cache
def inside_legs() -> Bool[Tensor, "k"]:
    """Boxes below the waist that face the other leg, down to the longest hem."""
    frames = _frames()
    facing = frames.rotation[:, 0, 2] * frames.position[:, 0].sign() < -FACING
    return facing & (frames.position[:, 1] < WAIST) & (frames.position[:, 1] > min(HEMS.values()))


def voxel_heights(boxes: Int[Tensor, "n"], sizes: Float[Tensor, "n 3"]) -> Float[Tensor, "n 512"]:
    """Heights of the voxels of boxes of these sizes (`delta_scale`) on the default body in the rest pose, metres."""
    frames, along = _frames(), torch.linspace(-1, 1, S, device=sizes.device)
    up, half, height = (
        field.to(sizes.device)[boxes] for field in (frames.rotation[:, 1], frames.half_extent, frames.position[:, 1])
    )
    t, b, n = ((up * half * sizes)[..., None] * along).unbind(1)
    return (height[:, None, None, None] + n[:, :, None, None] + b[:, None, :, None] + t[:, None, None]).flatten(1)


@functools.cache
def _frames() -> Frames:
    """The boxes of the default body in the rest pose."""
    body = default_body()
    return attach(default_anchors(), body.template, body.faces)
