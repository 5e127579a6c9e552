"""The adjoint on the CPU (SPEC 4): parallel over boxes, each with its own sums, hence deterministic without atomics.

Compositing is additive, so the gradient of a sample's opacity depends only on the sample and a few numbers of its ray
(`Upstream`), in any order: the backward pass needs no sorting and stores no samples of the forward pass.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64
from numpy import ndarray

from primdiffusion.render.cpu.compiled import TILE, index, kernel, part, take
from primdiffusion.render.cpu.forward import NEVER
from primdiffusion.render.cpu.sampling import (
    ENTER,
    HIT_ROWS,
    LANES,
    LEAVE,
    PIXELS,
    SAMPLES,
    TABLE_ROWS,
    hit_rays,
    lowest,
    place_samples,
    reference_point,
    tabulate,
    tile_rays,
)
from primdiffusion.render.cpu.vectors import adjoin_sample

RAYS = 4096
"""Rays weighed at a time."""


class Upstream(NamedTuple):
    """Gradient of a ray's samples: dL/da = <rgb, colour> + distance * (t - origin) + constant, up to its end."""

    rgb: Float32[ndarray, "r 3"]
    distance: Float32[ndarray, "r"]
    origin: Float32[ndarray, "r"]
    constant: Float32[ndarray, "r"]
    end: Int64[ndarray, "r"]
    """Lattice index of the last sample that contributes; later ones receive no gradient."""
    box: Int32[ndarray, "r"]
    """With index order: the last box that contributes there."""
    share: Float32[ndarray, "r"]
    """kappa: the fraction of the last sample that contributes."""


class Gradients(NamedTuple):
    """Sums over all rays; empty if not required."""

    rgb: Float32[ndarray, "k 3 n"]
    density: Float32[ndarray, "k n"]
    to_local: Float64[ndarray, "k 3 3"]
    offset: Float64[ndarray, "k 3"]
    pixel_to_world: Float64[ndarray, "k 3 3"]
    """Contribution of each box."""


@kernel
def weigh_rays(taken, upstream, alpha, depth, g_alpha, g_depth, end_rgb, spacing):
    """Fill distance, origin and constant from the image and its gradient.

    Distance is treated as a fourth colour: depth = sum w t / alpha.
    """
    begin = take(taken) * RAYS
    while begin < len(alpha):
        for ray in range(begin, min(begin + RAYS, len(alpha))):
            _weigh_ray(upstream, ray, alpha[ray], depth[ray], g_alpha[ray], g_depth[ray], end_rgb, spacing)
        begin = take(taken) * RAYS


@part()
def _weigh_ray(upstream, ray, alpha, depth, g_alpha, g_depth, end_rgb, spacing):
    visible = alpha > 0
    upstream.distance[ray] = g_depth / alpha if visible else 0
    if upstream.end[ray] == NEVER:
        upstream.origin[ray], upstream.constant[ray] = depth if visible else 0, g_alpha
    else:
        upstream.origin[ray], upstream.constant[ray] = upstream.end[ray] * spacing, 0
        for channel in range(3):
            upstream.constant[ray] -= upstream.rgb[ray, channel] * end_rgb[ray, channel]


class _Scratch(NamedTuple):
    """Buffers of one thread."""

    own: Float32[ndarray, "floats"]
    """dL/d(voxels), interleaved; empty if not required, as are the slopes."""
    slopes: Float32[ndarray, "8"]
    path: Float32[ndarray, "8"]
    table: Float32[ndarray, "floats"]
    rays: Float32[ndarray, "floats"]
    hits: Float32[ndarray, "floats"]
    block: Float32[ndarray, "floats"]
    d_point: Float64[ndarray, "3"]
    d_direction: Float64[ndarray, "3 3"]


@kernel
def adjoin_boxes(
    taken, gradients, upstream, boxes, size, rectangle, order, limits, pixel_to_world, width, height, spacing,
    index_order,
):  # fmt: skip
    """Accumulate into `gradients`, which must be zero. Other arguments as in `march_tiles`."""
    payload, geometry = len(gradients.density) > 0, len(gradients.to_local) > 0
    room = _Scratch(
        np.zeros(4 * size * size * size if payload else 0, np.float32),
        np.zeros(8 if geometry else 0, np.float32), np.zeros(8, np.float32),
        np.empty(LANES * TABLE_ROWS, np.float32), np.empty(3 * PIXELS, np.float32),
        np.empty(HIT_ROWS * LANES, np.float32), np.empty(8 * SAMPLES, np.float32), np.zeros(3), np.zeros((3, 3)),
    )  # fmt: skip
    i = take(taken)
    while i < len(order):
        k = order[i]
        if rectangle[k, 0] <= rectangle[k, 1]:
            _adjoin_box(
                gradients, upstream, boxes, size, rectangle, k, limits, pixel_to_world, width, height, spacing,
                index_order, room,
            )  # fmt: skip
        i = take(taken)


@part()
def _adjoin_box(
    gradients, upstream, boxes, size, rectangle, k, limits, pixel_to_world, width, height, spacing, index_order,
    room,
):  # fmt: skip
    """Process all rays through box k."""
    own, slopes, rays, hits, d_point, d_direction = (
        room.own, room.slopes, room.rays, room.hits, room.d_point, room.d_direction
    )  # fmt: skip
    own[:] = 0
    stride, ends, shares, last_box = boxes.stride[k], upstream.end, upstream.share, upstream.box
    step = stride * spacing
    length = np.float32(step)
    for tile_row in range(rectangle[k, 2], rectangle[k, 3] + 1):
        for tile_column in range(rectangle[k, 0], rectangle[k, 1] + 1):
            row0, column0 = tile_row * TILE, tile_column * TILE
            middle = tile_rays(rays, pixel_to_world, row0, column0)
            reference = reference_point(boxes, k, middle, spacing)
            distance = reference * spacing
            tabulate(room.table, 0, boxes, k, middle, reference, spacing)
            d_point[:] = 0
            d_direction[:] = 0
            for begin in range(0, PIXELS, LANES):
                hit = hit_rays(hits, room.table, rays, begin, PIXELS)
                while hit != 0:
                    j = index(lowest(hit))
                    hit &= hit - 1
                    row, column = row0 + (begin + j) // TILE, column0 + (begin + j) % TILE
                    if row >= height or column >= width:
                        continue
                    ray = index(row * width + column)
                    enter, leave = counted_steps(hits, j, reference, stride, limits, ray, ends[ray], k, last_box[ray])
                    if enter > leave:
                        continue
                    share = np.float32(1)
                    if reference + leave * stride == ends[ray] and (k == last_box[ray] or not index_order):
                        share = shares[ray]
                    per_metre = upstream.distance[ray]
                    _adjoin_segment(
                        own, slopes, room.path, boxes.voxels, 4 * k * size * size * size, size, room.block, hits, j,
                        enter, leave, length, share, upstream.rgb[ray, 0], upstream.rgb[ray, 1], upstream.rgb[ray, 2],
                        upstream.constant[ray] + per_metre * np.float32(distance - upstream.origin[ray]),
                        per_metre * length,
                    )  # fmt: skip
                    if len(slopes) > 0:
                        _turn_and_move(d_point, d_direction, slopes, middle, rays, begin + j, distance, step)
                        if len(gradients.pixel_to_world) > 0:
                            _aim(
                                gradients.pixel_to_world, slopes, boxes.to_local, k, distance, step, pixel_to_world,
                                row, column,
                            )  # fmt: skip
            if len(slopes) > 0:
                _add_tile(gradients.to_local, gradients.offset, d_point, d_direction, boxes, k, middle, distance)
    if len(own) > 0:
        _separate(gradients.rgb, gradients.density, own, k, size * size * size)


@part(inline=True)
def counted_steps(hits, lane, reference, stride, limits, ray, end, k, last_box):
    """First and last contributing step of a ray in box k, from the reference point."""
    enter, leave = np.int64(hits[ENTER * LANES + lane]), np.int64(hits[LEAVE * LANES + lane])
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
    own, slopes, path, voxels, base, size, block, hits, lane, enter, leave, length, share,
    red, green, blue, constant, per_step,
):  # fmt: skip
    """The adjoint of one ray in one box.

    own += dL/d(voxels); slopes [2, 4] = sum dL/dy and sum i * dL/dy over the steps i. dL/da = <(red, green, blue),
    colour> + constant + i * per_step.
    """
    row, half = 4 * size, np.float32(0.5 * (size - 1))
    slab = row * size
    slopes[:] = 0
    for axis in range(3):
        path[axis], path[4 + axis] = hits[axis * LANES + lane], hits[(3 + axis) * LANES + lane]
    for begin in range(enter, leave + 1, SAMPLES):
        place_samples(block, hits, lane, np.float32(begin), size, length)
        count = min(SAMPLES, leave + 1 - begin)
        if begin + count > leave:
            block[6 * SAMPLES + count - 1] *= share
        for j in range(count):
            step = np.float32(begin + j)
            adjoin_sample(
                own, slopes, path, voxels, base, 4 * np.int64(block[7 * SAMPLES + j]), row, slab,
                block[j], block[SAMPLES + j], block[2 * SAMPLES + j], block[3 * SAMPLES + j],
                block[4 * SAMPLES + j], block[5 * SAMPLES + j], block[6 * SAMPLES + j], half,
                red, green, blue, constant + step * per_step, step,
            )  # fmt: skip


@part()
def _turn_and_move(d_point, d_direction, slopes, middle, rays, pixel, distance, step):
    """Add one ray to a tile's sums of dL/dy, and of t * dL/dy times the direction minus distance * middle.

    y = to_local (o - T + t d) with t = distance + step * i; slopes contain sum dL/dy and sum i * dL/dy.
    """
    dx, dy, dz = rays[pixel], rays[PIXELS + pixel], rays[2 * PIXELS + pixel]
    x, y, z = middle[0] + dx, middle[1] + dy, middle[2] + dz
    for axis in range(3):
        far, along = distance * slopes[axis], step * slopes[4 + axis]
        d_point[axis] += slopes[axis]
        d_direction[axis, 0] += far * dx + along * x
        d_direction[axis, 1] += far * dy + along * y
        d_direction[axis, 2] += far * dz + along * z


@part()
def _aim(d_camera, slopes, to_local, k, distance, step, m, row, column):
    """Add one ray to dL/d(pixel_to_world): d = r / |r|, r = pixel_to_world [u, v, 1]."""
    vx, vy, vz = 0.0, 0.0, 0.0  # dL/dd
    for axis in range(3):
        s = distance * slopes[axis] + step * slopes[4 + axis]
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
    """Add a tile's sums to dL/d(to_local) and dL/d(offset)."""
    for axis in range(3):
        for other in range(3):
            near = boxes.offset[k, other] + distance * middle[other]
            d_matrix[k, axis, other] += d_point[axis] * near + d_direction[axis, other]
            d_offset[k, other] += boxes.to_local[k, axis, other] * d_point[axis]


@part()
def _separate(rgb, density, own, k, count):
    """Split interleaved voxels into colour and density."""
    for i in range(count):
        rgb[k, 0, i], rgb[k, 1, i], rgb[k, 2, i] = own[4 * i], own[4 * i + 1], own[4 * i + 2]
        density[k, i] = own[4 * i + 3]
