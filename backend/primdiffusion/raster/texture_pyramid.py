"""Textures at full size and halved, in flat arrays that compiled loops read: samples far apart need no aliasing."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Bool, Int32, Int64, UInt8

from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.raster.rasterise import LINEAR_OF_BYTE
from primdiffusion.raster.triangle_soup import UnusableMesh

LEVELS = 4
"""Full size and three halvings; coarser ones would mix what lies apart on the body."""
BYTE_STEPS = 1 << 16


@dataclasses.dataclass(frozen=True, eq=False)
class TexturePyramid:
    """The textures of all parts at all levels, row after row, in one array."""

    rgba: UInt8[np.ndarray, "texels 4"]
    """sRGB-encoded colour and straight alpha."""
    start: Int64[np.ndarray, "P L"]
    """Where a part's level begins."""
    size: Int32[np.ndarray, "P L 2"]
    """Rows and columns."""
    last: Int32[np.ndarray, "P"]
    """The coarsest level of a part."""
    cut_out: Bool[np.ndarray, "P"]
    """Whether any texel is transparent enough to be a hole."""


def texture_pyramid(mesh: TexturedMesh) -> TexturePyramid:
    """Texture and halvings of every part. Means are of linear colour weighted with alpha, so holes tint nothing.

    Raises:
        UnusableMesh: a part's texture has no texel.
    """
    flat: list[np.ndarray] = []
    start = np.zeros((len(mesh.parts), LEVELS), np.int64)
    size = np.ones((len(mesh.parts), LEVELS, 2), np.int32)
    last = np.zeros(len(mesh.parts), np.int32)
    texels = 0
    for number, part in enumerate(mesh.parts):
        if part.texture.size == 0:
            raise UnusableMesh(f"Part {part.name!r} has an empty texture; a plain colour is a 1 x 1 texture.")
        level = np.ascontiguousarray(part.texture)
        for depth in range(LEVELS):
            start[number, depth], size[number, depth] = texels, level.shape[:2]
            flat.append(level.reshape(-1, 4))
            texels += len(flat[-1])
            last[number] = depth
            if min(level.shape[:2]) < 2:
                break
            level = _halved(level, LINEAR_OF_BYTE, BYTE_OF_LINEAR)
    cut_out = np.array([bool((part.texture[..., 3] < 255).any()) for part in mesh.parts])
    return TexturePyramid(np.concatenate(flat), start, size, last, cut_out)


def _byte_table() -> UInt8[np.ndarray, "steps"]:
    linear = np.arange(BYTE_STEPS) / (BYTE_STEPS - 1)
    return np.round(encode_srgb(linear) * 255).astype(np.uint8)


BYTE_OF_LINEAR = _byte_table()
"""The sRGB-encoded byte of round(65535 * linear intensity)."""


@numba.njit(cache=True, nogil=True)
def encode_bytes(linear, byte_of_linear, encoded):
    """Writes the sRGB-encoded bytes of linear intensities [n], clamped to 0 ... 1."""
    for i in range(linear.shape[0]):
        value = min(max(linear[i], np.float32(0)), np.float32(1))
        encoded[i] = byte_of_linear[int(value * np.float32(BYTE_STEPS - 1) + np.float32(0.5))]


@numba.njit(cache=True, nogil=True)
def _halved(texture, linear_of_byte, byte_of_linear):
    rows, columns = texture.shape[0] // 2, texture.shape[1] // 2
    half = np.empty((rows, columns, 4), np.uint8)
    for row in range(rows):
        for column in range(columns):
            red, green, blue, alpha = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for i in range(4):
                texel = texture[2 * row + i // 2, 2 * column + i % 2]
                weight = np.float32(texel[3])
                red += weight * linear_of_byte[texel[0]]
                green += weight * linear_of_byte[texel[1]]
                blue += weight * linear_of_byte[texel[2]]
                alpha += weight
            scale = np.float32(65535) / alpha if alpha > 0 else np.float32(0)
            half[row, column, 0] = byte_of_linear[int(red * scale + np.float32(0.5))]
            half[row, column, 1] = byte_of_linear[int(green * scale + np.float32(0.5))]
            half[row, column, 2] = byte_of_linear[int(blue * scale + np.float32(0.5))]
            half[row, column, 3] = int(alpha / 4 + np.float32(0.5))
    return half
