"""What the authors' checkpoints mean by their numbers, turned into what this package means (SPEC 1, 2, 3)."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.model import WholeSlab
from primdiffusion.diffusion.schedule import leading_steps
from primdiffusion.primitives.anchors import released_half_extent
from primdiffusion.primitives.primitives import Payload
from primdiffusion.primitives.slab import RELEASED_FULL_DENSITY

FULL_DENSITY = RELEASED_FULL_DENSITY
VOLUME_RADIUS = 10.0
"""Metres: the marcher's unit, so that its scale 10 / h is the reciprocal half extent of a box of h metres (SPEC 2)."""
ENLARGED_BELOW, ENLARGED_BY = 350.0, 70.0
"""At inference, scales below the first are lowered by the second: boxes beyond 28.6 mm grow (SPEC 1.12)."""
SMALLEST_DELTA_S = 0.2
"""Released values are never clamped (SPEC 1.13); a box five times as large as at rest is a stray value, and 0 has no
reciprocal. What people wear lies about 1."""
_B_AXIS = -2
"""Of voxels, D, H, W = along N, B, T."""


@dataclasses.dataclass(frozen=True)
class ReleasedSlab(WholeSlab):
    """A slab whose boxes have B = T x N and delta_s that divides their size (SPEC 1.1, 1.8).

    Voxels are turned round along B, so that frames can stay in SO(3), and delta_scale = 1 / delta_s.
    """

    def to_payload(self, x0: Float[Tensor, "*b c h w"], full_density: float) -> Payload:
        """Unpacked and clamped."""
        found = super().to_payload(x0, full_density)
        return Payload(
            found.rgb.flip(_B_AXIS), found.density.flip(_B_AXIS), 1 / found.delta_scale.clamp_min(SMALLEST_DELTA_S)
        )

    def from_payload(self, payload: Payload, full_density: float) -> Float[Tensor, "*b c h w"]:
        """Packed; the inverse for boxes up to five times as large as at rest. ValueError for boxes without size."""
        if not (payload.delta_scale > 0).all():
            raise ValueError(
                "a delta scale is 0 or less: a released slab holds its reciprocal; refine the person again"
            )
        turned = Payload(payload.rgb.flip(_B_AXIS), payload.density.flip(_B_AXIS), 1 / payload.delta_scale)
        return super().from_payload(turned, full_density)


def rest_half_extent(position: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """Half extents (metres) for primitives at the reference's places (metres), enlarged as at inference."""
    scale = VOLUME_RADIUS / released_half_extent(position)
    return VOLUME_RADIUS / torch.where(scale < ENLARGED_BELOW, scale - ENLARGED_BY, scale)


def released_steps(length: int, steps: int) -> list[int]:
    """The released chain: 991, 981, ... 1 for 100 of 1000 (SPEC 3), or all of T-1 ... 0.

    Raises ValueError between T / 2 and T: such a chain begins far below the noise that sampling starts with.
    """
    if steps == length:
        return list(reversed(range(length)))
    if length // 2 < steps < length:
        raise ValueError(f"the released chain has up to {length // 2} steps, or all {length}; {steps} were asked for")
    return leading_steps(length, steps)
