"""Convert the conventions of the authors' checkpoints to this package's (SPEC 1, 2, 3)."""

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
"""Released values are never clamped (SPEC 1.13). Usual values are around 1; a box of five times its rest size is an
outlier, and 0 has no reciprocal."""
_B_AXIS = -2
"""The voxels' axes D, H, W run along N, B, T."""


@dataclasses.dataclass(frozen=True)
class ReleasedSlab(WholeSlab):
    """A slab whose boxes have B = T x N, and delta_s that divides their size (SPEC 1.1, 1.8).

    Conversion flips voxels along B, so that frames stay in SO(3), and delta_scale = 1 / delta_s.
    """

    def to_payload(self, x0: Float[Tensor, "*b c h w"], full_density: float) -> Payload:
        """Unpack and clamp."""
        payload = super().to_payload(x0, full_density)
        return Payload(
            payload.rgb.flip(_B_AXIS),
            payload.density.flip(_B_AXIS),
            1 / payload.delta_scale.clamp_min(SMALLEST_DELTA_S),
        )

    def from_payload(self, payload: Payload, full_density: float) -> Float[Tensor, "*b c h w"]:
        """Pack; the inverse for boxes up to five times their rest size. Raises ValueError for boxes without size."""
        if not (payload.delta_scale > 0).all():
            raise ValueError(
                "a delta scale is 0 or less, but released slabs store its reciprocal: refine this human again"
            )
        flipped = Payload(payload.rgb.flip(_B_AXIS), payload.density.flip(_B_AXIS), 1 / payload.delta_scale)
        return super().from_payload(flipped, full_density)


def rest_half_extent(position: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """Half extents (metres) of primitives at the reference positions (metres), enlarged as at inference."""
    scale = VOLUME_RADIUS / released_half_extent(position)
    return VOLUME_RADIUS / torch.where(scale < ENLARGED_BELOW, scale - ENLARGED_BY, scale)


def released_steps(length: int, steps: int) -> list[int]:
    """Timesteps of the released sampler: 991, 981, ... 1 for 100 of 1000 (SPEC 3), or all of T-1 ... 0.

    Raises ValueError between T / 2 and T: such a chain would begin far below the initial noise level.
    """
    if steps == length:
        return list(reversed(range(length)))
    if length // 2 < steps < length:
        raise ValueError(f"steps is {steps}: the released chain takes up to {length // 2} steps, or all {length}")
    return leading_steps(length, steps)
