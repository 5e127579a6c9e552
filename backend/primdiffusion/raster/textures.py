"""Textures in flat arrays, as compiled loops read them, and their halved copies."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt8

from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh

ALPHA_TEST = 128
"""Texels with a smaller alpha (of 255) are holes."""
LEVELS = 4
"""Full size and three halvings; coarser ones would mix distant parts of the body."""
BYTE_STEPS = 1 << 16
LINEAR_OF_BYTE = decode_srgb(np.arange(256, dtype=np.float64) / 255).astype(np.float32)
"""Linear intensity of an sRGB-encoded byte."""
BYTE_OF_LINEAR = np.round(encode_srgb(np.arange(BYTE_STEPS) / (BYTE_STEPS - 1)) * 255).astype(np.uint8)
"""The sRGB-encoded byte of round(65535 * linear intensity)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Textures:
    """The textures of all parts of a mesh at all levels, row after row, in one array."""

    rgba: UInt8[np.ndarray, "texels 4"]
    """sRGB-encoded colour and straight alpha."""
    start: Int64[np.ndarray, "P L"]
    """First texel of each level of each part."""
    size: Int32[np.ndarray, "P L 2"]
    """Rows and columns."""
    last: Int32[np.ndarray, "P"]
    """The coarsest level of a part."""
    cut_out: Bool[np.ndarray, "P"]
    """Whether any texel is not fully opaque."""


NO_TEXTURES = Textures(
    np.zeros((0, 4), np.uint8), np.zeros((0, LEVELS), np.int64), np.zeros((0, LEVELS, 2), np.int32),
    np.zeros(0, np.int32), np.zeros(0, np.bool_),
)  # fmt: skip


def gather_textures(mesh: TexturedMesh) -> Textures:
    """Each part's texture and its halvings, averaged in linear colour weighted by alpha so that holes tint nothing.

    Raises ValueError if a texture is empty.
    """
    _check_textures(mesh)
    textures, which = _distinct(mesh)
    sizes = [_level_sizes(*texture.shape[:2]) for texture in textures]
    rgba = np.empty((sum(rows * columns for levels in sizes for rows, columns in levels), 4), np.uint8)
    start = np.zeros((len(textures), LEVELS), np.int64)
    size = np.ones((len(textures), LEVELS, 2), np.int32)
    texels = 0
    for number, texture in enumerate(textures):
        level = np.ascontiguousarray(texture)
        for depth, (rows, columns) in enumerate(sizes[number]):
            if depth:
                level = _halved(level, LINEAR_OF_BYTE, BYTE_OF_LINEAR)
            start[number, depth], size[number, depth] = texels, (rows, columns)
            rgba[texels : texels + rows * columns] = level.reshape(-1, 4)
            texels += rows * columns
    last = np.array([len(levels) - 1 for levels in sizes], np.int32)
    cut_out = np.array([bool(texture[..., 3].min() < 255) for texture in textures])
    return Textures(rgba, start[which], size[which], last[which], cut_out[which])


def _distinct(mesh: TexturedMesh) -> tuple[list[UInt8[np.ndarray, "H W 4"]], Int64[np.ndarray, "P"]]:
    """The textures, those that parts share once, and the number of each part's texture among them."""
    textures = {id(part.texture): part.texture for part in mesh.parts}
    numbers = {identity: number for number, identity in enumerate(textures)}
    return list(textures.values()), np.array([numbers[id(part.texture)] for part in mesh.parts], np.int64)


def _level_sizes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Rows and columns of a texture and of its halvings."""
    sizes = [(rows, columns)]
    while len(sizes) < LEVELS and min(sizes[-1]) >= 2:
        sizes.append((sizes[-1][0] // 2, sizes[-1][1] // 2))
    return sizes


def mip_levels(texture: UInt8[np.ndarray, "H W 4"], count: int) -> list[Float32[np.ndarray, "h w 4"]]:
    """The texture and its `count` - 1 halvings: linear colour times weight, and weight.

    A texel weighs 1 if it passes the alpha test and 0 otherwise, so that holes tint nothing. Stops early at a side of
    one texel.
    """
    weight = (texture[..., 3:] >= ALPHA_TEST).astype(np.float32)
    level = np.concatenate([LINEAR_OF_BYTE[texture[..., :3]] * weight, weight], -1)
    result = [level]
    while len(result) < count and min(level.shape[:2]) > 1:
        height, width = (side // 2 * 2 for side in level.shape[:2])
        level = level[:height, :width].reshape(height // 2, 2, width // 2, 2, 4).mean((1, 3))
        result.append(level)
    return result


def _check_textures(mesh: TexturedMesh) -> None:
    for part in mesh.parts:
        if part.texture.size == 0:
            raise ValueError(
                f"Part {part.name!r} has an empty texture of shape {part.texture.shape}; "
                "a plain colour is a 1 x 1 texture."
            )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def alpha_at(u, v, rgba, start, rows, columns):
    """Alpha (of 255) of a texture at (u, v), which wrap around; v up."""
    x0, x1, y0, y1, wx, wy = texels_around(u, v, rows, columns)
    above, below, one = start + y0 * columns, start + y1 * columns, np.float32(1)
    upper = np.float32(rgba[above + x0, 3]) * (one - wx) + np.float32(rgba[above + x1, 3]) * wx
    lower = np.float32(rgba[below + x0, 3]) * (one - wx) + np.float32(rgba[below + x1, 3]) * wx
    return upper * (one - wy) + lower * wy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def texels_around(u, v, rows, columns):
    """Two columns and two rows of texels around (u, v), which wrap around, and the weights of the second of each."""
    x, y = (u - np.floor(u)) * columns - 0.5, (1.0 - (v - np.floor(v))) * rows - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    x1, y1 = x0 + 1, y0 + 1
    return (
        x0 if x0 >= 0 else columns - 1, x1 if x1 < columns else 0, y0 if y0 >= 0 else rows - 1, y1 if y1 < rows else 0,
        np.float32(x - x0), np.float32(y - y0),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def encode_bytes(linear, byte_of_linear, encoded):
    """Write the sRGB-encoded bytes of linear intensities [n], clamped to 0 ... 1."""
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
