"""Which boxes can be seen in which tile of a picture."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int32, Int64
from numpy import ndarray

from primdiffusion.render.cpu_compiled import part

TILE = 8
"""Pixels along a side of a tile."""
NEAR = 1e-6
"""Metres along the optical axis: boxes are cut off here, as what lies behind the camera has no place in the picture."""
MARGIN = 0.01
"""Pixels added around a box's rectangle against rounding."""
NOTHING = (0, -1, 0, -1)


def tiles_across(pixels: int) -> int:
    """Tiles in a row or column of so many pixels."""
    return -(-pixels // TILE)


def row_lists(
    rectangle: Int32[ndarray, "k 4"], down: int
) -> tuple[Int64[ndarray, "down+1"], Int32[ndarray, "entries"]]:
    """The boxes that reach into row i of tiles are the second array from the first one's [i] to [i + 1], in order.

    Lists per row and not per tile: memory grows with boxes x rows at worst.
    """
    first, last = rectangle[:, 2].astype(np.int64), rectangle[:, 3].astype(np.int64)
    count = np.maximum(last - first + 1, 0)
    box = np.repeat(np.arange(len(rectangle), dtype=np.int32), count)
    row = np.arange(len(box)) - np.repeat(np.cumsum(count) - count - first, count)
    order = np.argsort(row.astype(np.int16 if down < 2**15 else np.int64), kind="stable")
    start = np.zeros(down + 1, np.int64)
    np.cumsum(np.bincount(row, minlength=down), out=start[1:])
    return start, box[order]


def boxes_per_tile(rectangle: Int32[ndarray, "k 4"], across: int, down: int) -> Int64[ndarray, "tiles"]:
    """How many boxes each tile can see, row by row: an estimate of its work."""
    seen = rectangle[(rectangle[:, 0] <= rectangle[:, 1]) & (rectangle[:, 2] <= rectangle[:, 3])]
    change = np.zeros((down + 1, across + 1), np.int64)
    np.add.at(change, (seen[:, 2], seen[:, 0]), 1)
    np.add.at(change, (seen[:, 3] + 1, seen[:, 1] + 1), 1)
    np.add.at(change, (seen[:, 3] + 1, seen[:, 0]), -1)
    np.add.at(change, (seen[:, 2], seen[:, 1] + 1), -1)
    return change.cumsum(0).cumsum(1)[:down, :across].ravel()


@part()
def tile_rectangle(corners, across, down):
    """First and last tile column, first and last tile row around a box with the homogeneous pixel `corners` [8, 3].

    Corner 4 i + 2 j + k lies at the low or high end of the box's three axes as i, j, k are 0 or 1. What reaches behind
    the camera is cut off at NEAR first. last < first where nothing is in the picture.
    """
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for i in range(8):
        if corners[i, 2] >= NEAR:
            u, v = corners[i, 0] / corners[i, 2], corners[i, 1] / corners[i, 2]
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
        for axis in range(3):
            other = i | (1 << axis)
            if (corners[i, 2] < NEAR) != (corners[other, 2] < NEAR):
                share = (NEAR - corners[i, 2]) / (corners[other, 2] - corners[i, 2])
                u = (corners[i, 0] + share * (corners[other, 0] - corners[i, 0])) / NEAR
                v = (corners[i, 1] + share * (corners[other, 1] - corners[i, 1])) / NEAR
                left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    first_column, last_column = np.ceil(left - MARGIN - 0.5), np.floor(right + MARGIN - 0.5)
    first_row, last_row = np.ceil(top - MARGIN - 0.5), np.floor(bottom + MARGIN - 0.5)
    first_column, last_column = max(first_column, 0.0), min(last_column, across * TILE - 1.0)
    first_row, last_row = max(first_row, 0.0), min(last_row, down * TILE - 1.0)
    if not (first_column <= last_column and first_row <= last_row):
        return NOTHING
    columns = np.int64(first_column) // TILE, np.int64(last_column) // TILE
    return columns[0], columns[1], np.int64(first_row) // TILE, np.int64(last_row) // TILE
