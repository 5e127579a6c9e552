"""The records of the method: frames on a body, what fills them, and both together in the world (paper sec. 3.1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.geometry.records import TensorRecord

GRID = 32
"""Primitives along a side of the UV grid; primitive k sits in row k // GRID, column k % GRID."""
K = GRID * GRID
"""Primitives of a person."""
S = 8
"""Voxels along a side of a primitive."""
WINDOW_SHARPNESS = 8.0
WINDOW_POWER = 8
"""The window exp(-8 * sum |y|^8) fades a box's density towards its faces; payloads are made for it: no setting."""


@dataclasses.dataclass(frozen=True)
class Frames(TensorRecord):
    """Where each primitive sits on a posed body (paper sec. 3.1)."""

    position: Float[Tensor, "*b k 3"]
    """Centres in the world, metres."""
    rotation: Float[Tensor, "*b k 3 3"]
    """Local to world, in SO(3); columns are tangent T, bitangent B = N x T, normal N."""
    half_extent: Float[Tensor, "*b k 3"]
    """Half side lengths along T, B, N in metres; the marcher of the released code stores the reciprocal."""


@dataclasses.dataclass(frozen=True)
class Payload(TensorRecord):
    """What fills the primitives of one person; independent of pose and view.

    Voxel axes are D, H, W = along N, B, T. Voxel centres lie corner-aligned at -1 ... 1 of the box (SPEC 4).
    """

    rgb: Float[Tensor, "*b k 3 s s s"]
    """Linear RGB in [0, 1]."""
    density: Float[Tensor, "*b k s s s"]
    """Opacity per metre of ray, >= 0, before the window."""
    delta_scale: Float[Tensor, "*b k 3"]
    """Factors on the rest half extents along T, B, N; larger is larger."""

    def validate(self) -> Payload:
        """Itself, if the shapes agree and all values are finite; otherwise ValueError that names the field."""
        k = self.density.shape[-4] if self.density.ndim >= 4 else -1
        for name, tail in (("rgb", (k, 3, S, S, S)), ("density", (k, S, S, S)), ("delta_scale", (k, 3))):
            value: Tensor = getattr(self, name)
            if tuple(value.shape[-len(tail) :]) != tail:
                raise ValueError(f"payload field {name!r} has shape {tuple(value.shape)}; it must end in {tail}")
            if not torch.isfinite(value).all():
                raise ValueError(
                    f"payload field {name!r} holds NaN or infinite values; generate or import the person again"
                )
        return self


@dataclasses.dataclass(frozen=True)
class Primitives(TensorRecord):
    """Boxes in the world with their contents: what the marcher draws."""

    position: Float[Tensor, "*b k 3"]
    rotation: Float[Tensor, "*b k 3 3"]
    half_extent: Float[Tensor, "*b k 3"]
    rgb: Float[Tensor, "*b k 3 s s s"]
    density: Float[Tensor, "*b k s s s"]

    @classmethod
    def place(cls, frames: Frames, payload: Payload) -> Primitives:
        """The payload in its frames; half extents become rest half extent x delta scale."""
        half_extent = frames.half_extent * payload.delta_scale
        return cls(frames.position, frames.rotation, half_extent, payload.rgb, payload.density)

    @classmethod
    def together(cls, people: Sequence[Primitives]) -> Primitives:
        """The boxes of several people as one set, so that one picture shows them all; leading dimensions must agree."""
        after_k = {"position": 1, "rotation": 2, "half_extent": 1, "rgb": 4, "density": 3}
        return cls(
            **{
                name: torch.cat([getattr(person, name) for person in people], dim=-1 - dims)
                for name, dims in after_k.items()
            }
        )
