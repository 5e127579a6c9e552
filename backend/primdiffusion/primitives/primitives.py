"""The records of the method (paper sec. 3.1): frames on a body, their payload, and both combined in world space."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.formats import body_layout
from primdiffusion.geometry.records import TensorRecord

GRID = body_layout.GRID
"""Primitives along a side of the UV grid."""
K = GRID * GRID
"""Primitives per human."""
S = 8
"""Voxels along a side of a primitive."""
WINDOW_SHARPNESS = 8.0
WINDOW_POWER = 8
"""The window exp(-8 * sum |y|^8) fades density towards the faces of a box. Not configurable: payloads depend on it."""


@dataclasses.dataclass(frozen=True)
class Frames(TensorRecord):
    """Pose and size of each primitive on a posed body (paper sec. 3.1)."""

    position: Float[Tensor, "*b k 3"]
    """Centres in the world, metres."""
    rotation: Float[Tensor, "*b k 3 3"]
    """Local to world, in SO(3); columns are tangent T, bitangent B = N x T, normal N."""
    half_extent: Float[Tensor, "*b k 3"]
    """Half side lengths along T, B, N in metres; the marcher of the released code stores the reciprocal."""


@dataclasses.dataclass(frozen=True)
class Payload(TensorRecord):
    """Colour, density and scale of the primitives of one human; independent of pose and view.

    Voxel axes are D, H, W = along N, B, T. Voxel centres lie corner-aligned at -1 ... 1 of the box (SPEC 4).
    """

    rgb: Float[Tensor, "*b k 3 s s s"]
    """Linear RGB in [0, 1]."""
    density: Float[Tensor, "*b k s s s"]
    """Opacity per metre of ray, >= 0, before the window."""
    delta_scale: Float[Tensor, "*b k 3"]
    """Factors on the rest half extents along T, B, N."""

    def validate(self) -> Payload:
        """Return self if the shapes agree and all values are finite; otherwise raise ValueError."""
        k = self.density.shape[-4] if self.density.ndim >= 4 else -1
        for name, tail in (("rgb", (k, 3, S, S, S)), ("density", (k, S, S, S)), ("delta_scale", (k, 3))):
            value: Tensor = getattr(self, name)
            if tuple(value.shape[-len(tail) :]) != tail:
                raise ValueError(f"payload field {name!r} has shape {tuple(value.shape)}; it must end in {tail}")
            if not torch.isfinite(value).all():
                raise ValueError(
                    f"payload field {name!r} holds NaN or infinite values: generate or import the human again"
                )
        return self


@dataclasses.dataclass(frozen=True)
class Primitives(TensorRecord):
    """Boxes of voxels in world space: the input of the marcher."""

    position: Float[Tensor, "*b k 3"]
    rotation: Float[Tensor, "*b k 3 3"]
    half_extent: Float[Tensor, "*b k 3"]
    rgb: Float[Tensor, "*b k 3 s s s"]
    density: Float[Tensor, "*b k s s s"]

    @classmethod
    def place(cls, frames: Frames, payload: Payload) -> Primitives:
        """Combine frames and payload; half extent = rest half extent x delta scale."""
        half_extent = frames.half_extent * payload.delta_scale
        return cls(frames.position, frames.rotation, half_extent, payload.rgb, payload.density)

    @classmethod
    def together(cls, people: Sequence[Primitives]) -> Primitives:
        """Concatenate the primitives of several humans, to render them together; leading dimensions must agree."""
        after_k = {"position": 1, "rotation": 2, "half_extent": 1, "rgb": 4, "density": 3}
        return cls(
            **{
                name: torch.cat([getattr(person, name) for person in people], dim=-1 - dims)
                for name, dims in after_k.items()
            }
        )
