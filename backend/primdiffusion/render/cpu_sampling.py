"""Rays, boxes and samples of one tile of pixels: what the CPU's forward pass and its adjoint share.

Large terms cancel once per tile and box, in float64: a box's coordinates are taken from the lattice point nearest to
its centre on the ray through the tile's middle, and a pixel's ray by how it differs from that middle one. What is left
is of the order of the box, and float32 does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from primdiffusion.primitives.primitives import WINDOW_SHARPNESS
from primdiffusion.render.cpu_compiled import index, part
from primdiffusion.render.cpu_hits import (
    AT_CENTRE,
    FIRST,
    HIGH,
    LANES,
    LOW,
    PER_STEP,
    STEPS,
    TABLE_ROWS,
    TO_LOCAL,
)
from primdiffusion.render.cpu_vectors import add_sample, power_of_two
from primdiffusion.render.tiles import TILE

SAMPLES = 8
"""Samples whose places and weights are computed together."""
PIXELS = TILE * TILE

_DECAY = np.float32(-WINDOW_SHARPNESS / math.log(2))
_EXPONENT = np.float32(-126)


class PackedBoxes(NamedTuple):
    """The boxes as the kernels read them. y = to_local (x - T) is in [-1, 1]^3 (SPEC 4)."""

    to_local: Float64[ndarray, "k 3 3"]
    offset: Float64[ndarray, "k 3"]
    """From each box's centre to the camera, metres."""
    stride: Int64[ndarray, "k"]
    nearest: Float64[ndarray, "k"]
    """No point of the box is nearer to the camera, metres; may be negative."""
    low: Float32[ndarray, "k 3"]
    """Where in y the box holds density: from low to high, per axis."""
    high: Float32[ndarray, "k 3"]
    voxels: Float32[ndarray, "floats"]
    """[k, d, h, w, (red, green, blue, density)], flat."""


@part()
def tile_rays(rays, pixel_to_world, row0, column0):
    """Fills rays [3, PIXELS] (flat) with each pixel's unit direction less the middle's, which it returns."""
    m = pixel_to_world
    ux, uy, uz, vx, vy, vz = m[0, 0], m[1, 0], m[2, 0], m[0, 1], m[1, 1], m[2, 1]
    u, v = column0 + 0.5 * TILE, row0 + 0.5 * TILE
    cx, cy, cz = ux * u + vx * v + m[0, 2], uy * u + vy * v + m[1, 2], uz * u + vz * v + m[2, 2]
    inverse = 1.0 / math.sqrt(cx * cx + cy * cy + cz * cz)
    middle = (cx * inverse, cy * inverse, cz * inverse)
    for pixel in range(PIXELS):
        right, down = pixel % TILE + (0.5 - 0.5 * TILE), pixel // TILE + (0.5 - 0.5 * TILE)
        x, y, z = cx + right * ux + down * vx, cy + right * uy + down * vy, cz + right * uz + down * vz
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        rays[pixel] = x * inverse - middle[0]
        rays[PIXELS + pixel] = y * inverse - middle[1]
        rays[2 * PIXELS + pixel] = z * inverse - middle[2]
    return middle


@part()
def reference_point(boxes, k, middle, spacing):
    """The lattice index, a multiple of the box's stride, nearest to box k's centre on the tile's middle ray."""
    o = boxes.offset[k]
    step = boxes.stride[k] * spacing
    along = -(middle[0] * o[0] + middle[1] * o[1] + middle[2] * o[2])
    return max(np.int64(along / step + 0.5), 0) * boxes.stride[k]


@part(inline=True)
def tabulate(table, place, boxes, k, middle, reference, spacing):
    """Writes box k's row entries at `place`, seen along the tile's middle ray from its reference point."""
    stride = boxes.stride[k]
    distance, step = reference * spacing, stride * spacing
    x = boxes.offset[k, 0] + distance * middle[0]
    y = boxes.offset[k, 1] + distance * middle[1]
    z = boxes.offset[k, 2] + distance * middle[2]
    for axis in range(3):
        a, b, c = boxes.to_local[k, axis, 0], boxes.to_local[k, axis, 1], boxes.to_local[k, axis, 2]
        table[place + (AT_CENTRE + axis) * LANES] = a * x + b * y + c * z
        table[place + (PER_STEP + axis) * LANES] = step * (a * middle[0] + b * middle[1] + c * middle[2])
        table[place + (TO_LOCAL + 3 * axis) * LANES] = step * a
        table[place + (TO_LOCAL + 3 * axis + 1) * LANES] = step * b
        table[place + (TO_LOCAL + 3 * axis + 2) * LANES] = step * c
        table[place + (LOW + axis) * LANES] = boxes.low[k, axis]
        table[place + (HIGH + axis) * LANES] = boxes.high[k, axis]
    steps = reference // stride
    table[place + STEPS * LANES] = steps
    table[place + FIRST * LANES] = 1 - steps


@part()
def leave_empty(table, place):
    """A lane that no ray hits."""
    for row in range(TABLE_ROWS):
        table[place + row * LANES] = 0
    table[place + FIRST * LANES] = np.inf


@part(inline=True)
def place_samples(block, hits, hit, first, size, length):
    """Cells, weights and windows of SAMPLES samples from step `first` on: fills block [8, SAMPLES], flat.

    Lane `hit` of `hits` holds y at step 0 and dy per step (see `hit_boxes`). Rows of block: 0-3 the weights of a cell's
    edges, 4 and 5 those of an edge's ends, 6 window * length, 7 the cell's first voxel.
    """
    hit = index(hit)
    one = np.float32(1)
    width = np.float32(size)
    half, last = np.float32(0.5) * (width - one), width - np.float32(2)
    ex, ey, ez = hits[hit], hits[LANES + hit], hits[2 * LANES + hit]
    qx, qy, qz = hits[3 * LANES + hit], hits[4 * LANES + hit], hits[5 * LANES + hit]
    for j in range(SAMPLES):
        step = first + np.float32(j)
        x, y, z = ex + step * qx, ey + step * qy, ez + step * qz
        cu, fu = _cell(x, half, last)
        cv, fv = _cell(y, half, last)
        cw, fw = _cell(z, half, last)
        gv, gw = one - fv, one - fw
        block[j] = gv * gw
        block[SAMPLES + j] = fv * gw
        block[2 * SAMPLES + j] = gv * fw
        block[3 * SAMPLES + j] = fv * fw
        block[4 * SAMPLES + j] = one - fu
        block[5 * SAMPLES + j] = fu
        block[6 * SAMPLES + j] = length * _window(x, y, z)
        block[7 * SAMPLES + j] = (cw * width + cv) * width + cu


@part(inline=True)
def _cell(y, half, last):
    place = y * half + half
    cell = min(max(np.floor(place), np.float32(0)), last)
    return cell, place - cell


@part(inline=True)
def _window(x, y, z):
    """exp(-8 sum |y|^8), to 2e-7 relative."""
    x4, y4, z4 = x * x * (x * x), y * y * (y * y), z * z * (z * z)
    exponent = max(_DECAY * (x4 * x4 + y4 * y4 + z4 * z4), _EXPONENT)
    whole = np.floor(exponent)
    f = exponent - whole
    # 2^f on [0, 1), minimax; in pairs, which wait for one another less than Horner's rule does.
    square = f * f
    low = np.float32(6.9315308e-1) * f + np.float32(9.9999994e-1)
    middle = np.float32(5.5826318e-2) * f + np.float32(2.4015361e-1)
    high = np.float32(1.8775767e-3) * f + np.float32(8.9893397e-3)
    return (low + square * (middle + square * high)) * power_of_two(whole)


@part(inline=True)
def add_segment(points, slot, slots, voxels, base, size, block, hits, hit, first, count, length):
    """Adds `count` samples of one box, from step `first` on, to points[slot], points[slot + slots], ..."""
    row = size * 4
    slab = size * row
    for begin in range(0, count, SAMPLES):
        place_samples(block, hits, hit, first + np.float32(begin), size, length)
        for j in range(min(SAMPLES, count - begin)):
            corner = base + 4 * np.int64(block[7 * SAMPLES + j])
            add_sample(
                points, slot, voxels, corner, row, slab,
                block[j], block[SAMPLES + j], block[2 * SAMPLES + j], block[3 * SAMPLES + j],
                block[4 * SAMPLES + j], block[5 * SAMPLES + j], block[6 * SAMPLES + j],
            )  # fmt: skip
            slot += slots
