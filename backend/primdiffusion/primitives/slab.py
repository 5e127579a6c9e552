"""The slab: a payload as the 56-channel image that is diffused (SPEC 3; paper sec. 3.3).

The constants 255, 20 and 0.182 appear nowhere else.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.geometry.srgb import decode_srgb, encode_srgb
from primdiffusion.primitives.primitives import GRID, Payload, S

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
