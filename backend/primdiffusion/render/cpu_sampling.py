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

from primdiffusion.render.cpu_compiled import part
from primdiffusion.render.cpu_vectors import add_sample, power_of_two
from primdiffusion.render.lattice import WINDOW_SHARPNESS
from primdiffusion.render.tiles import TILE

LANES = 16
"""Rays or boxes that are tested together."""
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
    low: Float32[ndarray, "k 3"]
    """Where in y the box holds density: from low to high, per axis."""
    high: Float32[ndarray, "k 3"]
    voxels: Float32[ndarray, "floats"]
    """[k, d, h, w, (red, green, blue, density)], flat."""


# Rows of a tile's table of boxes; box i is lane i % LANES of block i // LANES, so a row of a block is one vector.
_AT_CENTRE, _PER_STEP, _TO_LOCAL, _STEPS, _LOW, _HIGH, _FIRST = 0, 3, 6, 15, 16, 19, 22
TABLE_ROWS = 23
# Rows of a block of ray-box tests: y at the reference point, dy per step, first and last step from that point.
HIT_ROWS = 8


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
        table[place + (_AT_CENTRE + axis) * LANES] = a * x + b * y + c * z
        table[place + (_PER_STEP + axis) * LANES] = step * (a * middle[0] + b * middle[1] + c * middle[2])
        table[place + (_TO_LOCAL + 3 * axis) * LANES] = step * a
        table[place + (_TO_LOCAL + 3 * axis + 1) * LANES] = step * b
        table[place + (_TO_LOCAL + 3 * axis + 2) * LANES] = step * c
        table[place + (_LOW + axis) * LANES] = boxes.low[k, axis]
        table[place + (_HIGH + axis) * LANES] = boxes.high[k, axis]
    steps = reference // stride
    table[place + _STEPS * LANES] = steps
    table[place + _FIRST * LANES] = 1 - steps


@part()
def leave_empty(table, place):
    """A lane that no ray hits."""
    for row in range(TABLE_ROWS):
        table[place + row * LANES] = 0
    table[place + _FIRST * LANES] = np.inf


@part()
def hit_boxes(hits, table, block, dx, dy, dz):
    """One ray (by its difference from the middle) against LANES boxes: fills hits [HIT_ROWS, LANES], flat."""
    place = np.int64(np.uint32(block))  # not negative: what the vectoriser must know
    for j in range(LANES):
        _hit(hits, j, table, place + j, dx, dy, dz)


@part()
def hit_rays(hits, table, rays, first):
    """LANES rays from `first` on against the table's first box: fills hits [HIT_ROWS, LANES], flat."""
    place = np.int64(np.uint32(first))
    for j in range(LANES):
        _hit(hits, j, table, 0, rays[place + j], rays[PIXELS + place + j], rays[2 * PIXELS + place + j])


@part(inline=True)
def _hit(hits, lane, table, place, dx, dy, dz):
    ex, qx, enter_x, leave_x = _axis_hit(table, place, 0, dx, dy, dz)
    ey, qy, enter_y, leave_y = _axis_hit(table, place, 1, dx, dy, dz)
    ez, qz, enter_z, leave_z = _axis_hit(table, place, 2, dx, dy, dz)
    hits[lane], hits[LANES + lane], hits[2 * LANES + lane] = ex, ey, ez
    hits[3 * LANES + lane], hits[4 * LANES + lane], hits[5 * LANES + lane] = qx, qy, qz
    hits[6 * LANES + lane] = np.ceil(max(max(enter_x, enter_y), max(enter_z, table[place + _FIRST * LANES])))
    hits[7 * LANES + lane] = np.floor(min(min(leave_x, leave_y), leave_z))


@part(inline=True)
def _axis_hit(table, place, axis, dx, dy, dz):
    along = (
        table[place + (_TO_LOCAL + 3 * axis) * LANES] * dx
        + table[place + (_TO_LOCAL + 3 * axis + 1) * LANES] * dy
        + table[place + (_TO_LOCAL + 3 * axis + 2) * LANES] * dz
    )
    q = table[place + (_PER_STEP + axis) * LANES] + along
    e = table[place + (_AT_CENTRE + axis) * LANES] + table[place + _STEPS * LANES] * along
    # A ray parallel to a face gets a tiny slope instead of a division by zero; beside the box it then still misses.
    inverse = np.float32(1) / (q if abs(q) > np.float32(1e-12) else np.float32(1e-12))
    a = (table[place + (_LOW + axis) * LANES] - e) * inverse
    b = (table[place + (_HIGH + axis) * LANES] - e) * inverse
    return e, q, min(a, b), max(a, b)


@part(inline=True)
def place_samples(block, lines, hit, first, size, length):
    """Cells, weights and windows of SAMPLES samples from step `first` on: fills block [8, SAMPLES], flat.

    lines[hit] holds y at step 0 and dy per step. Rows: 0-3 the weights of a cell's edges, 4 and 5 those of an edge's
    ends, 6 window * length, 7 the cell's first voxel.
    """
    one = np.float32(1)
    width = np.float32(size)
    half, last = np.float32(0.5) * (width - one), width - np.float32(2)
    ex, ey, ez = lines[hit, 0], lines[hit, 1], lines[hit, 2]
    qx, qy, qz = lines[hit, 3], lines[hit, 4], lines[hit, 5]
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


@part()
def add_segment(points, slot, slots, voxels, base, size, block, lines, hit, first, count, length):
    """Adds `count` samples of one box, from step `first` on, to points[slot], points[slot + slots], ..."""
    row = size * 4
    slab = size * row
    for begin in range(0, count, SAMPLES):
        place_samples(block, lines, hit, first + np.float32(begin), size, length)
        for j in range(min(SAMPLES, count - begin)):
            corner = base + 4 * np.int64(block[7 * SAMPLES + j])
            add_sample(
                points, slot, voxels, corner, row, slab,
                block[j], block[SAMPLES + j], block[2 * SAMPLES + j], block[3 * SAMPLES + j],
                block[4 * SAMPLES + j], block[5 * SAMPLES + j], block[6 * SAMPLES + j],
            )  # fmt: skip
            slot += slots
