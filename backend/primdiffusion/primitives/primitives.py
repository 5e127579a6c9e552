"""The records of the method (paper sec. 3.1): frames on a body, their payload, and both combined in world space.

And the slab: a payload as the 56-channel image that is diffused (SPEC 3; paper sec. 3.3).

The constants 255, 20 and 0.182 of the slab appear nowhere else.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.formats import body_layout
from primdiffusion.geometry.image import decode_srgb, encode_srgb
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
    """Boxes of voxels in world space: the input of the marcher.

    >>> pd.Primitives.together([boxes, boxes]).density.shape  # two humans, to be drawn in one picture
    torch.Size([2048, 8, 8, 8])
    """

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


CHANNELS_PER_LAYER = 7
"""Per voxel: encoded RGB, density, delta scale along T, B, N."""
RELEASED_FULL_DENSITY = 25.5
"""Density (1/m) encoded as 255 in the authors' checkpoints."""
DELTA_SCALE_UNIT = 255 / 20
NETWORK_SCALE = 0.182


def pack(payload: Payload, full_density: float) -> Float[Tensor, "*b 56 256 256"]:
    """Encode a payload as network input, x = (v / 255 * 2 - 1) * 0.182 with v in 0 ... 255 (SPEC 3).

    Channel = d*7 + c, row = ny*8 + h, column = nx*8 + w for the voxel (d, h, w) of primitive ny*32 + nx; c runs over
    sRGB-encoded red, green, blue, density and the three delta scales, which are repeated over the voxels.
    `full_density` (1/m) is the density encoded as 255. Values are not clamped, so `unpack` is the exact inverse.
    Raises ValueError if the payload is invalid or `full_density` is not positive.
    """
    _check_full_density(full_density)
    payload.validate()
    delta_scale = payload.delta_scale[..., None, None, None].expand_as(payload.rgb)
    density = payload.density.unsqueeze(-4)
    layers = [encode_srgb(payload.rgb) * 255, density * (255 / full_density), delta_scale * DELTA_SCALE_UNIT]
    value = torch.cat(layers, dim=-4)
    slab = value.unflatten(-5, (GRID, GRID))  # ny nx c d h w
    slab = slab.movedim((-3, -4, -6, -2, -5, -1), (-6, -5, -4, -3, -2, -1))  # d c ny h nx w
    slab = slab.flatten(-2).flatten(-3, -2).flatten(-4, -3)
    return (slab / 255 * 2 - 1) * NETWORK_SCALE


def unpack(slab: Float[Tensor, "*b 56 256 256"], full_density: float) -> Payload:
    """Decode a slab: the inverse of `pack` (SPEC 3).

    Sampled slabs may leave the valid range, so colours are clamped to 0 ... 1, and densities and delta scales to
    non-negative values. The delta scale is the mean over its 8^3 copies. Raises ValueError if the slab's shape is not
    [*b, 56, 256, 256] or `full_density` (1/m) is not positive.
    """
    _check_full_density(full_density)
    expected = (S * CHANNELS_PER_LAYER, GRID * S, GRID * S)
    if tuple(slab.shape[-3:]) != expected:
        raise ValueError(
            f"the slab has shape {tuple(slab.shape)}; it must end in {expected}: pass the network's complete output"
        )
    value = (slab / NETWORK_SCALE + 1) / 2 * 255
    value = value.unflatten(-1, (GRID, S)).unflatten(-3, (GRID, S)).unflatten(-5, (S, CHANNELS_PER_LAYER))
    # d c ny h nx w
    value = value.movedim((-6, -5, -4, -3, -2, -1), (-3, -4, -6, -2, -5, -1)).flatten(-6, -5)  # k c d h w
    rgb, density, delta_scale = value.split((3, 1, 3), dim=-4)
    return Payload(
        rgb=decode_srgb((rgb / 255).clamp(0, 1)),
        density=(density.squeeze(-4) * (full_density / 255)).clamp_min(0),
        delta_scale=(delta_scale.mean((-3, -2, -1)) / DELTA_SCALE_UNIT).clamp_min(0),
    )


def _check_full_density(full_density: float) -> None:
    if not full_density > 0:
        raise ValueError(f"full_density is {full_density}; it must be the positive density (1/m) that 255 stands for")
