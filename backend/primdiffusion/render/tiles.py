"""Which boxes can be seen in which tile of a picture."""

from __future__ import annotations

import itertools

import numba
import numpy as np
import torch
from jaxtyping import Int64
from numpy import ndarray

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives

TILE = 16
"""Pixels along a side of a tile."""
NEAR = 1e-6
"""Metres; boxes that come closer to the camera's plane than this cannot be bounded by projected corners."""
MARGIN = 0.01
"""Pixels added around a box's rectangle against rounding."""


def tile_lists(primitives: Primitives, camera: Camera) -> tuple[Int64[ndarray, "tiles+1"], Int64[ndarray, "hits"]]:
    """The boxes of tile i (row by row) are the second array from the first one's [i] to [i + 1], in index order.

    A box is listed in every tile that the rectangle around its eight projected corners touches. One that reaches from
    in front of the camera to behind it, or holds it, is listed in all tiles; one wholly behind in none.
    """
    across, down = (-(-camera.width // TILE), -(-camera.height // TILE))
    return _lists(_tile_rectangles(primitives, camera, across, down), across, down)


def _tile_rectangles(primitives: Primitives, camera: Camera, across: int, down: int) -> Int64[ndarray, "k 4"]:
    """First and last tile column, first and last tile row of each box; last < first for boxes out of sight."""
    signs = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3)), dtype=torch.float64)
    boxes = primitives.to(dtype=torch.float64)
    offsets = signs * boxes.half_extent[:, None, :]
    corners = boxes.position[:, None, :] + offsets @ boxes.rotation.transpose(-1, -2)
    pixels, depth = (value.numpy() for value in camera.map(lambda t: t.detach().cpu().double()).project(corners))

    whole = np.array([0, across - 1, 0, down - 1])
    crossing = (depth.min(1) <= NEAR) & (depth.max(1) > 0)
    in_front = depth.min(1) > NEAR
    rectangles = np.tile(np.array([0, -1, 0, -1]), (len(depth), 1))
    low, high = pixels[in_front].min(1) - MARGIN, pixels[in_front].max(1) + MARGIN
    tiles = np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], axis=1) // TILE
    limits = np.array([across, across, down, down])
    tiles = np.clip(tiles, -1, limits).astype(np.int64)
    tiles[:, [0, 2]] = np.maximum(tiles[:, [0, 2]], 0)
    tiles[:, [1, 3]] = np.minimum(tiles[:, [1, 3]], limits[[1, 3]] - 1)
    rectangles[in_front] = tiles
    rectangles[crossing] = whole
    return rectangles


@numba.njit(cache=True)
def _lists(rectangles, across, down):
    start = np.zeros(across * down + 1, np.int64)
    for k in range(len(rectangles)):
        for row in range(rectangles[k, 2], rectangles[k, 3] + 1):
            for column in range(rectangles[k, 0], rectangles[k, 1] + 1):
                start[row * across + column + 1] += 1
    start = np.cumsum(start)
    filled = start[:-1].copy()
    box = np.empty(start[-1], np.int64)
    for k in range(len(rectangles)):
        for row in range(rectangles[k, 2], rectangles[k, 3] + 1):
            for column in range(rectangles[k, 0], rectangles[k, 1] + 1):
                tile = row * across + column
                box[filled[tile]] = k
                filled[tile] += 1
    return start, box
