"""Textures of hair, brows and lashes: natural colours times shading from the pack's texture, or a procedural one."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import binary_dilation, gaussian_filter

from primdiffusion.people.assets import Assets
from primdiffusion.people.colour import bytes_from_linear, luminance
from primdiffusion.people.texel_map import TexelMap, texel_map, uv_islands
from primdiffusion.people.wardrobe import hair_path, stream

SIZE = 512
CURLY = ("afro01",)
OPAQUE = 128
"""Alpha from which a texel is opaque, as in the rasteriser's alpha test."""


@dataclasses.dataclass(frozen=True, eq=False)
class Strands:
    """The texture of a hair mesh without colour."""

    shade: Float[np.ndarray, "H W"]
    """Shading, with median 1."""
    alpha: UInt8[np.ndarray, "H W"]


@functools.lru_cache(maxsize=16)
def strands(assets: Assets, name: str) -> Strands:
    """Get the strands of a hair mesh: from its texture, or procedural if the pack has none."""
    picture = f"{hair_path(name)}_diffuse"
    if not assets.has_picture(picture):
        corner_uv = assets.proxy(hair_path(name))[1].corner_uv
        texels = texel_map(corner_uv, SIZE)
        return _curls(texels, uv_islands(corner_uv)) if name in CURLY else _straight(texels, name)
    texture = assets.picture(picture, SIZE)
    light = luminance(texture[..., :3])
    middle = np.median(light[texture[..., 3] >= OPAQUE])
    return Strands(np.clip((light + 0.01) / (middle + 0.01), 0.2, 2.5) ** 0.7, texture[..., 3])


def coloured_strands(hair: Strands, colour: Float[np.ndarray, "3"]) -> UInt8[np.ndarray, "H W 4"]:
    """Colour strands with one linear colour."""
    rgb = bytes_from_linear(np.clip(hair.shade[..., None] * colour.astype(np.float64), 0, 1))
    return np.concatenate([rgb, hair.alpha[..., None]], axis=-1)


def tinted_cutout(picture: UInt8[np.ndarray, "H W 4"], colour: Float[np.ndarray, "3"]) -> UInt8[np.ndarray, "H W 4"]:
    """Colour brows or lashes with one linear colour; alpha is increased so that they pass the alpha test."""
    texture = np.empty_like(picture)
    texture[..., :3] = bytes_from_linear(colour.astype(np.float64))
    texture[..., 3] = np.minimum(picture[..., 3].astype(np.int32) * 3 // 2, 255).astype(np.uint8)
    return texture


def _straight(texels: TexelMap, name: str) -> Strands:
    """Procedural strands along the texture's columns, with ragged ends at the bottom of each island."""
    draws = stream(0, f"strands of {name}")
    noise = draws.standard_normal((3, SIZE, SIZE)).astype(np.float64)
    shade = sum(
        share * _unit(gaussian_filter(layer, spread))
        for layer, share, spread in zip(noise, (0.8, 1.0, 0.8), ((60, 0.7), (80, 1.6), (100, 5)), strict=True)
    )
    below = np.zeros((SIZE, SIZE), np.float64)
    above = np.zeros((SIZE, SIZE), np.float64)
    for row in range(SIZE - 2, -1, -1):
        below[row] = np.where(texels.inside[row], below[row + 1] + 1, 0)
    for row in range(1, SIZE):
        above[row] = np.where(texels.inside[row], above[row - 1] + 1, 0)
    reach = np.abs(_unit(gaussian_filter(draws.standard_normal((SIZE, SIZE)).astype(np.float64), (40, 0.8))))
    ragged = below > 0.06 * (below + above) * reach
    # Dilated sideways across island borders, or gaps would open between adjacent sheets.
    opaque = binary_dilation(ragged, np.ones((1, 5), bool))
    return Strands(np.exp(0.22 * shade).astype(np.float64), np.where(opaque, 255, 0).astype(np.uint8))


def _curls(texels: TexelMap, island: Int[np.ndarray, " F"]) -> Strands:
    """Procedural isotropic curls: the two largest islands, a cap, are opaque; the tufts around it have gaps."""
    draws = stream(0, "curls")
    noise = draws.standard_normal((2, SIZE, SIZE)).astype(np.float64)
    curls, tufts = _unit(gaussian_filter(noise[0], 2.0)), _unit(gaussian_filter(noise[1], 7.0))
    edge = gaussian_filter(texels.inside.astype(np.float64), 5)
    opaque = (island < 2)[texels.face] | (curls + tufts + 6 * (edge - 0.6) > 0)
    shade = _unit(gaussian_filter(noise[0], 1.2)) + 0.6 * curls + 0.8 * tufts
    return Strands(np.exp(0.2 * shade).astype(np.float64), np.where(opaque, 255, 0).astype(np.uint8))


def _unit(field: np.ndarray) -> np.ndarray:
    """Normalise to mean 0 and standard deviation 1."""
    return (field - field.mean()) / field.std()
