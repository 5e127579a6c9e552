"""Pack boxes and camera for the CPU kernels: checked, bounded, interleaved, nearest first."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64
from numpy import ndarray
from torch import Tensor

from primdiffusion.render.cpu.compiled import (
    NOTHING,
    boxes_per_tile,
    kernel,
    on_all_threads,
    part,
    row_lists,
    take,
    tile_rectangle,
    tiles_across,
)
from primdiffusion.render.cpu.sampling import PackedBoxes
from primdiffusion.render.lattice import ORTHOGONAL


class PackedScene(NamedTuple):
    """The packed boxes of an image, and the lists of boxes that its tiles see."""

    boxes: PackedBoxes
    rectangle: Int32[ndarray, "k 4"]
    """First and last column, first and last row of tiles of each box; last < first if it is not visible."""
    row_start: Int64[ndarray, "down+1"]
    row_box: Int32[ndarray, "entries"]
    """The boxes of each row of tiles, nearest first (see `row_lists`)."""
    tile_boxes: Int64[ndarray, "tiles"]
    """Number of boxes that each tile sees."""
    pixel_to_world: Float64[ndarray, "3 3"]
    size: int
    """Voxels along each side of a box."""
    may_be_degenerate: bool
    """Whether a box may have NaN, infinite or negative values or an invalid rotation; `check_scene` finds which."""


def pack(
    rgb: Float[Tensor, "k 3 s s s"],
    density: Float[Tensor, "k s s s"],
    to_local: Float64[Tensor, "k 3 3"],
    offset: Float64[Tensor, "k 3"],
    rotation: Float[Tensor, "k 3 3"],
    stride: Int64[Tensor, "k"],
    solid: Bool[Tensor, "k"],
    pixel_to_world: Float64[Tensor, "3 3"],
    width: int,
    height: int,
    *,
    empty_cells: bool,
) -> PackedScene:
    """Pack one image's scene; boxes that are not `solid` are invisible.

    Boxes are cropped to the cells with density, except with `empty_cells`, which the gradient of density needs.
    """
    k, size = density.shape[0], density.shape[-1]
    across, down = tiles_across(width), tiles_across(height)
    voxels = np.empty(k * 4 * size**3, np.float32)
    low, high = np.empty((k, 3), np.float32), np.empty((k, 3), np.float32)
    rectangle, nearest = np.empty((k, 4), np.int32), np.empty(k)
    may_be_degenerate = np.empty(k, np.bool_)
    local, away, to_world = (value.contiguous().numpy() for value in (to_local, offset, pixel_to_world))
    on_all_threads(
        _pack_boxes, voxels, low, high, rectangle, nearest, may_be_degenerate,
        rgb.contiguous().numpy().reshape(-1), density.contiguous().numpy().reshape(-1), size, local,
        away, rotation.contiguous().numpy(), solid.numpy(), to_world, across, down, empty_cells,
    )  # fmt: skip
    boxes = PackedBoxes(local, away, stride.numpy(), nearest, low, high, voxels)
    seen = np.flatnonzero(rectangle[:, 0] <= rectangle[:, 1])
    seen = seen[np.argsort(nearest[seen], kind="stable")]
    row_start, row_place = row_lists(rectangle[seen], down)
    tile_boxes = boxes_per_tile(rectangle, across, down)
    row_box = seen.astype(np.int32)[row_place]
    return PackedScene(boxes, rectangle, row_start, row_box, tile_boxes, to_world, size, bool(may_be_degenerate.any()))


def heaviest_first(work: Int64[ndarray, "n"]) -> Int64[ndarray, "n"]:
    """Order tasks by descending work, so that threads finish together."""
    return np.argsort(-work, kind="stable")


@kernel
def _pack_boxes(
    taken, voxels, low, high, rectangle, nearest, may_be_degenerate,
    rgb, density, size, to_local, offset, rotation, solid, pixel_to_world, across, down, empty_cells,
):  # fmt: skip
    corners, to_world, world_to_pixel = np.empty((8, 3)), np.empty((3, 3)), np.empty((3, 3))
    _invert(world_to_pixel, pixel_to_world)
    k = take(taken)
    while k < len(solid):
        _pack_box(
            voxels, low[k], high[k], rectangle[k], nearest, may_be_degenerate, rgb, density, size, k, to_local[k],
            offset[k], rotation[k], solid[k], world_to_pixel, across, down, empty_cells, corners, to_world,
        )  # fmt: skip
        k = take(taken)


@part()
def _pack_box(
    voxels, low, high, rectangle, nearest, may_be_degenerate, rgb, density, size, k, to_local, offset, rotation, solid,
    world_to_pixel, across, down, empty_cells, corners, to_world,
):  # fmt: skip
    """Pack box k, given some of its rows; the last two arguments are scratch."""
    count = size**3
    own = density[k * count : (k + 1) * count]
    colour = rgb[3 * k * count : 3 * (k + 1) * count]
    may_be_degenerate[k] = _may_be_degenerate(own, colour, to_local, offset, rotation)
    rectangle[0], rectangle[1], rectangle[2], rectangle[3] = NOTHING
    for axis in range(3):
        low[axis], high[axis] = -1, 1
    if not solid or not (empty_cells or _shrink(low, high, own, size)):
        return
    _invert(to_world, to_local)
    nearest[k] = _place_corners(corners, to_world, low, high, offset, world_to_pixel)
    rectangle[0], rectangle[1], rectangle[2], rectangle[3] = tile_rectangle(corners, across, down)
    if rectangle[0] <= rectangle[1]:
        _interleave(voxels[4 * k * count : 4 * (k + 1) * count], own, colour, count)


@part()
def _may_be_degenerate(density, rgb, to_local, offset, rotation):
    zero, least = np.float32(0), np.float32(0)
    for i in range(len(density)):
        zero += density[i] * np.float32(0)
        least = min(least, density[i])
    for i in range(len(rgb)):
        zero += rgb[i] * np.float32(0)
    excess = 0.0
    for i in range(3):
        zero += np.float32(offset[i] * 0.0)
        if to_local[i, 0] == 0 and to_local[i, 1] == 0 and to_local[i, 2] == 0:
            return True  # an infinite extent
        for j in range(3):
            zero += np.float32(to_local[i, j] * 0.0)
            product = 0.0
            for a in range(3):
                product += rotation[a, i] * rotation[a, j]
            excess = max(excess, abs(product - (1.0 if i == j else 0.0)))
    return not (zero == 0 and least >= 0 and excess <= ORTHOGONAL)


@part()
def _shrink(low, high, density, size):
    """Narrow low ... high to where trilinear density can be positive; return False if it is nowhere."""
    first_w, last_w, first_h, last_h, first_d, last_d = size, -1, size, -1, size, -1
    for d in range(size):
        for h in range(size):
            begin = (d * size + h) * size
            densest = np.float32(0)
            for w in range(size):
                densest = max(densest, density[begin + w])
            if densest > 0:
                first_h, last_h, first_d, last_d = min(first_h, h), max(last_h, h), min(first_d, d), d
                w = 0
                while density[begin + w] == 0:
                    w += 1
                first_w = min(first_w, w)
                w = size - 1
                while density[begin + w] == 0:
                    w -= 1
                last_w = max(last_w, w)
    _narrow(low, high, 0, first_w, last_w, size)
    _narrow(low, high, 1, first_h, last_h, size)
    _narrow(low, high, 2, first_d, last_d, size)
    return last_d >= 0


@part()
def _narrow(low, high, axis, first, last, size):
    low[axis] = max(2.0 * (first - 1) / (size - 1) - 1, -1.0)
    high[axis] = min(2.0 * (last + 1) / (size - 1) - 1, 1.0)


@part()
def _place_corners(corners, to_world, low, high, offset, world_to_pixel):
    """Compute the box's corners as homogeneous pixels; return a lower bound of its distance to the camera, metres.

    The bound is the smallest projection of a corner onto the direction to the box's centre.
    """
    middle, distance = (0.0, 0.0, 0.0), 0.0
    for axis in range(3):
        place = -offset[axis]
        for other in range(3):
            place += to_world[axis, other] * 0.5 * (low[other] + high[other])
        middle = (middle[1], middle[2], place)
        distance += place * place
    nearest, scale = np.inf, 1.0 / max(math.sqrt(distance), 1e-12)
    for i in range(8):
        x = high[0] if i & 1 else low[0]
        y = high[1] if i & 2 else low[1]
        z = high[2] if i & 4 else low[2]
        a = to_world[0, 0] * x + to_world[0, 1] * y + to_world[0, 2] * z - offset[0]
        b = to_world[1, 0] * x + to_world[1, 1] * y + to_world[1, 2] * z - offset[1]
        c = to_world[2, 0] * x + to_world[2, 1] * y + to_world[2, 2] * z - offset[2]
        nearest = min(nearest, (middle[0] * a + middle[1] * b + middle[2] * c) * scale)
        for axis in range(3):
            corners[i, axis] = world_to_pixel[axis, 0] * a + world_to_pixel[axis, 1] * b + world_to_pixel[axis, 2] * c
    return nearest


@part()
def _invert(result, m):
    """result = the inverse of m [3, 3]."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for axis in range(3):
            b, c = (axis + 1) % 3, (axis + 2) % 3
            result[axis, i] = m[j, b] * m[k, c] - m[j, c] * m[k, b]
    inverse = 1.0 / (m[0, 0] * result[0, 0] + m[0, 1] * result[1, 0] + m[0, 2] * result[2, 0])
    for i in range(3):
        for axis in range(3):
            result[i, axis] *= inverse


@part()
def _interleave(voxels, density, rgb, count):
    for i in range(count):
        voxels[4 * i] = rgb[i]
        voxels[4 * i + 1] = rgb[count + i]
        voxels[4 * i + 2] = rgb[2 * count + i]
        voxels[4 * i + 3] = density[i]
