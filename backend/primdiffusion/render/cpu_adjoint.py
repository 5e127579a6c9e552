"""The CPU's adjoint (SPEC 4): boxes in parallel, each with sums of its own, so nothing is atomic and results repeat.

Compositing is additive, so what a sample's opacity is worth follows from the sample and from a few numbers of its ray
(`Upstream`) alone, in whatever order: the backward pass needs no sorting and no memory of the forward pass's samples.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64
from numpy import ndarray

from primdiffusion.render.cpu_compiled import kernel, part
from primdiffusion.render.cpu_sampling import (
    HIT_ROWS,
    LANES,
    PIXELS,
    SAMPLES,
    TABLE_ROWS,
    hit_rays,
    place_samples,
    reference_point,
    tabulate,
    tile_rays,
)
from primdiffusion.render.cpu_vectors import adjoin_sample
from primdiffusion.render.lattice import WINDOW_POWER, WINDOW_SHARPNESS
from primdiffusion.render.tiles import TILE

ZERO = np.float32(0)


class Upstream(NamedTuple):
    """What each ray's samples are worth: dL/da = <rgb, colour> + distance * (t - origin) + constant, up to its end."""

    rgb: Float32[ndarray, "r 3"]
    distance: Float32[ndarray, "r"]
    origin: Float32[ndarray, "r"]
    constant: Float32[ndarray, "r"]
    end: Int64[ndarray, "r"]
    """The lattice index of the last sample that counts; what lies behind receives nothing."""
    box: Int32[ndarray, "r"]
    """With index order: the last box that counts there."""
    share: Float32[ndarray, "r"]
    """kappa: the part of the last sample that counts."""


class Gradients(NamedTuple):
    """Sums over all rays. Those that nobody needs are empty."""

    rgb: Float32[ndarray, "k 3 n"]
    density: Float32[ndarray, "k n"]
    to_local: Float64[ndarray, "k 3 3"]
    offset: Float64[ndarray, "k 3"]
    pixel_to_world: Float64[ndarray, "k 3 3"]
    """Each box's part of it."""


@kernel
def adjoin_boxes(gradients, upstream, boxes, size, rectangle, order, limits, pixel_to_world, width, height, spacing,
    index_order,
):  # fmt: skip
    """Fills `gradients`, which must hold zeros. limits as in `march_tiles`."""
    payload, geometry = len(gradients.density) > 0, len(gradients.to_local) > 0
    for i in numba.prange(len(order)):
        k = order[i]
        if rectangle[k, 0] <= rectangle[k, 1]:
            _adjoin_box(
                gradients, upstream, boxes, size, rectangle, k, limits, pixel_to_world, width, height, spacing,
                index_order,
                np.zeros(4 * size * size * size if payload else 0, np.float32),
                np.zeros(8 if geometry else 0, np.float32), np.empty((2, 3), np.float32),
                np.empty(LANES * TABLE_ROWS, np.float32), np.empty(3 * PIXELS, np.float32),
                np.empty(HIT_ROWS * LANES, np.float32), np.empty((1, 6), np.float32),
                np.empty(8 * SAMPLES, np.float32), np.empty(SAMPLES, np.float32), np.zeros(3), np.zeros((3, 3)),
            )  # fmt: skip


@part()
def _adjoin_box(
    gradients, upstream, boxes, size, rectangle, k, limits, pixel_to_world, width, height, spacing, index_order,
    own, slopes, slope, table, rays, hits, lines, block, worth, d_point, d_direction,
):  # fmt: skip
    """All rays through box k; the arrays after `index_order` are room to work in, own and slopes zeros."""
    stride, ends, shares, last_box = boxes.stride[k], upstream.end, upstream.share, upstream.box
    step = stride * spacing
    length = np.float32(step)
    for tile_row in range(rectangle[k, 2], rectangle[k, 3] + 1):
        for tile_column in range(rectangle[k, 0], rectangle[k, 1] + 1):
            row0, column0 = tile_row * TILE, tile_column * TILE
            middle = tile_rays(rays, pixel_to_world, row0, column0)
            reference = reference_point(boxes, k, middle, spacing)
            distance = reference * spacing
            tabulate(table, 0, boxes, k, middle, reference, spacing)
            d_point[:] = 0
            d_direction[:] = 0
            for begin in range(0, PIXELS, LANES):
                hit_rays(hits, table, rays, begin)
                for j in range(LANES):
                    row, column = row0 + (begin + j) // TILE, column0 + (begin + j) % TILE
                    if hits[6 * LANES + j] > hits[7 * LANES + j] or row >= height or column >= width:
                        continue
                    ray = row * width + column
                    enter, leave = _steps(hits, j, reference, stride, limits, ray, ends[ray], k, last_box[ray])
                    if enter > leave:
                        continue
                    for entry in range(6):
                        lines[0, entry] = hits[entry * LANES + j]
                    share = np.float32(1)
                    if reference + leave * stride == ends[ray] and (k == last_box[ray] or not index_order):
                        share = shares[ray]
                    per_metre = upstream.distance[ray]
                    _adjoin_segment(
                        own, slopes, slope, boxes.voxels, 4 * k * size * size * size, size, block, worth, lines,
                        enter, leave, length, share, upstream.rgb[ray, 0], upstream.rgb[ray, 1], upstream.rgb[ray, 2],
                        upstream.constant[ray] + per_metre * np.float32(distance - upstream.origin[ray]),
                        per_metre * length,
                    )  # fmt: skip
                    if len(slopes) > 0:
                        _turn_and_move(d_point, d_direction, slope, middle, rays, begin + j, distance, step)
                        if len(gradients.pixel_to_world) > 0:
                            _aim(
                                gradients.pixel_to_world, slope, boxes.to_local, k, distance, step, pixel_to_world,
                                row, column,
                            )  # fmt: skip
            if len(slopes) > 0:
                _add_tile(gradients.to_local, gradients.offset, d_point, d_direction, boxes, k, middle, distance)
    if len(own) > 0:
        _separate(gradients.rgb, gradients.density, own, k, size * size * size)


@part(inline=True)
def _steps(hits, lane, reference, stride, limits, ray, end, k, last_box):
    """First and last step, from the reference point, of a ray in box k that count."""
    enter, leave = np.int64(hits[6 * LANES + lane]), np.int64(hits[7 * LANES + lane])
    last = end if k <= last_box else end - 1
    first = np.int64(1)
    if len(limits) > 0:
        first, last = limits[ray, 0], min(last, limits[ray, 1])
    if reference + enter * stride < first:
        enter = -((reference - first) // stride)
    if reference + leave * stride > last:
        leave = (last - reference) // stride
    return enter, leave


@part()
def _adjoin_segment(
    own, slopes, slope, voxels, base, size, block, worth, lines, enter, leave, length, share,
    red, green, blue, constant, per_step,
):  # fmt: skip
    """The adjoint of one ray in one box.

    own += dL/d(voxels); slope = sum dL/dy and sum i * dL/dy over the steps i. dL/da = <(red, green, blue), colour> +
    constant + i * per_step.
    """
    row, half = 4 * size, np.float32(0.5 * (size - 1))
    slab = row * size
    x0, y0, z0, x1, y1, z1 = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    for entry in range(len(slopes)):
        slopes[entry] = 0
    for begin in range(enter, leave + 1, SAMPLES):
        place_samples(block, lines, 0, np.float32(begin), size, length)
        count = min(SAMPLES, leave + 1 - begin)
        if begin + count > leave:
            block[6 * SAMPLES + count - 1] *= share
        for j in range(SAMPLES):
            worth[j] = 0
        for j in range(count):
            step = np.float32(begin + j)
            v, w = block[SAMPLES + j] + block[3 * SAMPLES + j], block[2 * SAMPLES + j] + block[3 * SAMPLES + j]
            worth[j] = adjoin_sample(
                own, slopes, voxels, base, 4 * np.int64(block[7 * SAMPLES + j]), row, slab, v, w,
                block[4 * SAMPLES + j], block[5 * SAMPLES + j], block[6 * SAMPLES + j], red, green, blue,
                constant + step * per_step, step,
            )  # fmt: skip
        if len(slopes) > 0:
            a0, b0, c0, a1, b1, c1 = _window_slopes(worth, lines, np.float32(begin))
            x0, y0, z0, x1, y1, z1 = x0 + a0, y0 + b0, z0 + c0, x1 + a1, y1 + b1, z1 + c1
    if len(slopes) > 0:
        slope[0, 0], slope[0, 1], slope[0, 2], slope[1, 0], slope[1, 1], slope[1, 2] = x0, y0, z0, x1, y1, z1
        for axis in range(3):
            slope[0, axis] += half * slopes[axis]
            slope[1, axis] += half * slopes[4 + axis]


@part(inline=True)
def _window_slopes(worth, lines, first):
    """sum worth * d log(window) / dy, and the same times the step, of SAMPLES samples."""
    x0, y0, z0 = np.float32(0), np.float32(0), np.float32(0)
    x1, y1, z1 = np.float32(0), np.float32(0), np.float32(0)
    ex, ey, ez, qx, qy, qz = lines[0, 0], lines[0, 1], lines[0, 2], lines[0, 3], lines[0, 4], lines[0, 5]
    for j in range(SAMPLES):
        step = first + np.float32(j)
        x = worth[j] * _window_slope(ex + step * qx)
        y = worth[j] * _window_slope(ey + step * qy)
        z = worth[j] * _window_slope(ez + step * qz)
        x0, y0, z0 = x0 + x, y0 + y, z0 + z
        x1, y1, z1 = x1 + step * x, y1 + step * y, z1 + step * z
    return x0, y0, z0, x1, y1, z1


@part(inline=True)
def _window_slope(y):
    y = min(max(y, np.float32(-1)), np.float32(1))  # lanes past the segment may be anywhere
    cube = y * y * y
    return np.float32(-WINDOW_SHARPNESS * WINDOW_POWER) * (cube * cube * y)


@part()
def _turn_and_move(d_point, d_direction, slope, middle, rays, pixel, distance, step):
    """Adds one ray to a tile's sums of dL/dy and of t * dL/dy times the direction, less distance * middle.

    y = to_local (o - T + t d) with t = distance + step * i; slope holds sum dL/dy and sum i * dL/dy.
    """
    dx, dy, dz = rays[pixel], rays[PIXELS + pixel], rays[2 * PIXELS + pixel]
    x, y, z = middle[0] + dx, middle[1] + dy, middle[2] + dz
    for axis in range(3):
        far, along = distance * slope[0, axis], step * slope[1, axis]
        d_point[axis] += slope[0, axis]
        d_direction[axis, 0] += far * dx + along * x
        d_direction[axis, 1] += far * dy + along * y
        d_direction[axis, 2] += far * dz + along * z


@part()
def _aim(d_camera, slope, to_local, k, distance, step, m, row, column):
    """Adds one ray to dL/d(pixel_to_world): d = r / |r|, r = pixel_to_world [u, v, 1]."""
    vx, vy, vz = 0.0, 0.0, 0.0  # dL/dd
    for axis in range(3):
        s = distance * slope[0, axis] + step * slope[1, axis]
        vx += to_local[k, axis, 0] * s
        vy += to_local[k, axis, 1] * s
        vz += to_local[k, axis, 2] * s
    u, v = column + 0.5, row + 0.5
    rx = m[0, 0] * u + m[0, 1] * v + m[0, 2]
    ry = m[1, 0] * u + m[1, 1] * v + m[1, 2]
    rz = m[2, 0] * u + m[2, 1] * v + m[2, 2]
    inverse = 1.0 / math.sqrt(rx * rx + ry * ry + rz * rz)
    dot = (rx * vx + ry * vy + rz * vz) * inverse * inverse
    vx, vy, vz = (vx - dot * rx) * inverse, (vy - dot * ry) * inverse, (vz - dot * rz) * inverse
    for axis, value in enumerate((vx, vy, vz)):
        d_camera[k, axis, 0] += value * u
        d_camera[k, axis, 1] += value * v
        d_camera[k, axis, 2] += value


@part()
def _add_tile(d_matrix, d_offset, d_point, d_direction, boxes, k, middle, distance):
    """Adds a tile's sums to dL/d(to_local) and dL/d(offset)."""
    for axis in range(3):
        for other in range(3):
            near = boxes.offset[k, other] + distance * middle[other]
            d_matrix[k, axis, other] += d_point[axis] * near + d_direction[axis, other]
            d_offset[k, other] += boxes.to_local[k, axis, other] * d_point[axis]


@part()
def _separate(rgb, density, own, k, count):
    """From interleaved voxels to colour and density."""
    for i in range(count):
        rgb[k, 0, i], rgb[k, 1, i], rgb[k, 2, i] = own[4 * i], own[4 * i + 1], own[4 * i + 2]
        density[k, i] = own[4 * i + 3]
