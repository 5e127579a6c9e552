"""What a human's boxes show from outside, as a surface: it is drawn at once where a marched picture takes a while."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

VOXELS = 8
"""Along a side of a box."""
VISIBLE = 0.3
"""Opacity along a box's normal from which on its surface is drawn: neighbours overlap where each is fainter."""
_HALF = 0.5
_CELL = np.array([[0, 1, VOXELS], [1, VOXELS + 1, VOXELS]])
"""Corners of the two triangles of a cell, as steps in a grid [B, T] of voxels."""


@dataclasses.dataclass(frozen=True, eq=False)
class Relief:
    """A surface over each box: for each column of voxels along its normal, where that becomes opaque from outside."""

    place: NDArray[np.float32]
    """Vertices [N, 3] in their box: T, B, N in [-1, 1]."""
    tint: NDArray[np.float32]
    """Linear colour and opacity of the column [N, 4]; where the opacity is below VISIBLE there is nothing."""
    box: NDArray[np.float32]
    """Index of the vertex' box [N]."""
    triangles: NDArray[np.int32]
    """Vertices of each [M, 3]."""


def relief_of(rgb: NDArray, density: NDArray, thickness: NDArray) -> Relief:
    """The surface of boxes with linear `rgb` [K, 3, 8, 8, 8] and `density` [K, 8, 8, 8] in 1/m, axes N, B, T, each
    `thickness` [K] metres high along N.

    The opacity of a column is the sum of docs/design/marcher.md along N, with the window; its height is where half of
    it, at most one half, is above; its colour the mean of what a ray from outside sees.
    """
    centres = np.linspace(-1, 1, VOXELS, dtype=np.float32)
    window = np.exp(-8 * centres**8)
    weights = window[:, None, None] * window[:, None] * window
    step = np.asarray(thickness, np.float32)[:, None, None, None] / (VOXELS - 1)
    above = np.cumsum((density * weights * step)[:, ::-1], 1)
    opacity = above[:, -1]
    seen = np.diff(np.minimum(above, 1), axis=1, prepend=0)
    colour = np.einsum("knbt,kcnbt->kbtc", seen, rgb[:, :, ::-1]) / np.maximum(opacity.clip(0, 1), 1e-6)[..., None]
    tint = np.concatenate([colour, opacity.clip(0, 1)[..., None]], -1)
    height = _height(above, np.minimum(opacity, 1) * _HALF)
    across = np.broadcast_arrays(centres[None, None, :], centres[None, :, None], height)
    return _without_hidden(np.stack(across, -1), tint)


def _height(above: NDArray, wanted: NDArray) -> NDArray:
    """N in [-1, 1] where sums from outside [K, 8, 8, 8] reach what is wanted [K, 8, 8], between two voxels."""
    first = (above >= wanted[:, None]).argmax(1)[:, None]
    here = np.take_along_axis(above, first, 1)[:, 0]
    before = np.where(first > 0, np.take_along_axis(above, np.maximum(first - 1, 0), 1), 0)[:, 0]
    part = (wanted - before) / np.maximum(here - before, 1e-9)
    return np.clip(1 - 2 / (VOXELS - 1) * (first[:, 0] - 1 + part), -1, 1)


def _without_hidden(place: NDArray, tint: NDArray) -> Relief:
    """The cells of grids [K, 8, 8, ..] that are visible somewhere, and their vertices."""
    visible = tint[..., 3] >= VISIBLE
    cells = visible[:, :-1, :-1] | visible[:, :-1, 1:] | visible[:, 1:, :-1] | visible[:, 1:, 1:]
    box, b, t = np.nonzero(cells)
    corners = (((box * VOXELS + b) * VOXELS + t)[:, None, None] + _CELL).reshape(-1, 3)
    seen = np.zeros(tint[..., 3].size, np.bool_)
    seen[corners] = True
    used, triangles = np.flatnonzero(seen), (np.cumsum(seen) - 1)[corners]
    return Relief(
        place.reshape(-1, 3)[used].astype(np.float32),
        tint.reshape(-1, 4)[used].astype(np.float32),
        (used // VOXELS**2).astype(np.float32),
        triangles.reshape(-1, 3).astype(np.int32),
    )
