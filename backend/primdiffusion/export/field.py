"""The volume of a set of boxes sampled at points: density, colour, and skin weights."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from numpy import ndarray as Array

from primdiffusion.primitives.primitives import WINDOW_POWER, WINDOW_SHARPNESS, Primitives

CELL = 0.04
"""Cell size of the acceleration grid, metres; no effect on the result."""
NEAREST = 0.03
"""Falloff of skin weights with distance beyond the nearest box's centre, metres. A box may reach into the other leg
and must not move it."""
_POWER, _SHARPNESS = int(WINDOW_POWER), float(WINDOW_SHARPNESS)


class Field(NamedTuple):
    """Boxes in an acceleration grid: each cell lists the boxes that overlap it."""

    position: Float64[Array, "k 3"]
    to_local: Float64[Array, "k 3 3"]
    """y = to_local (x - position) is in [-1, 1]^3 within a box."""
    voxels: Float32[Array, "k d h w 4"]
    """Linear red, green, blue, and density (1/m)."""
    low: Float64[Array, "3"]
    start: Int64[Array, "cells"]
    """Offset of each cell's boxes in `box`, and the total."""
    box: Int64[Array, "n"]
    cells: Int64[Array, "3"]


def pack_field(primitives: Primitives) -> Field:
    """Pack an unbatched set of boxes; boxes without extent are left out."""
    solid = (primitives.half_extent > 0).all(-1).nonzero()[:, 0]
    boxes = {name: tensor.detach().cpu()[solid.cpu()] for name, tensor in vars(primitives).items()}
    half, rotation = boxes["half_extent"].double().numpy(), boxes["rotation"].double().numpy()
    position = boxes["position"].double().numpy()
    reach = np.einsum("kij,kj->ki", np.abs(rotation), half)
    low = (position - reach).min(0) if len(solid) else np.zeros(3)
    high = (position + reach).max(0) if len(solid) else np.zeros(3)
    cells = np.maximum(np.ceil((high - low) / CELL), 1).astype(np.int64)
    first = np.floor((position - reach - low) / CELL).astype(np.int64).clip(0, cells - 1)
    last = np.floor((position + reach - low) / CELL).astype(np.int64).clip(0, cells - 1)
    start, box = _listed(first, last, cells)
    rgb = np.moveaxis(boxes["rgb"].float().numpy(), 1, -1)
    voxels = np.concatenate([rgb, boxes["density"].float().numpy()[..., None]], -1)
    to_local = np.swapaxes(rotation, 1, 2) / half[:, :, None]
    return Field(position, np.ascontiguousarray(to_local), np.ascontiguousarray(voxels), low, start, box, cells)


def density_at(field: Field, points: Float[Array, "n 3"]) -> Float32[Array, "n"]:
    """Windowed density, summed over boxes (1/m)."""
    return _density(field, np.ascontiguousarray(points, np.float64))


def march_rays(
    field: Field, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"], length: float, step: float
) -> tuple[Float32[Array, "n 3"], Float32[Array, "n"]]:
    """March rays of `length` (m) in steps of `step`: straight (not premultiplied) linear colour, and opacity.

    Composited as by the marcher: opacities add up until 1 is reached (SPEC 4). Empty rays are black.
    """
    rays = (np.ascontiguousarray(origins, np.float64), np.ascontiguousarray(directions, np.float64))
    return _march(field, *rays, math.ceil(length / step), step)


def weights_at(field: Field, points: Float[Array, "n 3"], box_weights: Float[Array, "k j"]) -> Float32[Array, "n j"]:
    """Skin weights at points: a mean over the boxes there, weighted by density and closeness (NEAREST).

    Rows sum to one; they are zero where density is zero.
    """
    return _weights(field, np.ascontiguousarray(points, np.float64), np.ascontiguousarray(box_weights, np.float32))


@numba.njit(cache=True, nogil=True)
def _listed(first, last, cells):  # pragma: no cover (compiled)
    start = np.zeros(cells[0] * cells[1] * cells[2] + 1, np.int64)
    for fill in range(2):
        if fill == 1:
            start[1:] = np.cumsum(start[1:])
            place = start.copy()
            box = np.empty(start[-1], np.int64)
        for k in range(len(first)):
            for x in range(first[k, 0], last[k, 0] + 1):
                for y in range(first[k, 1], last[k, 1] + 1):
                    for z in range(first[k, 2], last[k, 2] + 1):
                        cell = (x * cells[1] + y) * cells[2] + z
                        if fill == 0:
                            start[cell + 1] += 1
                        else:
                            box[place[cell]] = k
                            place[cell] += 1
    return start, box


@numba.njit(cache=True, nogil=True)
def _cell_of(field, x, y, z):  # pragma: no cover (compiled)
    i = math.floor((x - field.low[0]) / CELL)
    j = math.floor((y - field.low[1]) / CELL)
    k = math.floor((z - field.low[2]) / CELL)
    n = field.cells
    if i < 0 or j < 0 or k < 0 or i >= n[0] or j >= n[1] or k >= n[2]:
        return -1
    return (i * n[1] + j) * n[2] + k


@numba.njit(cache=True, nogil=True)
def _in_box(field, k, x, y, z, value):  # pragma: no cover (compiled)
    """Write colour and windowed density of box k at a point to `value`; return False if the point is outside."""
    dx, dy, dz = x - field.position[k, 0], y - field.position[k, 1], z - field.position[k, 2]
    m = field.to_local[k]
    a = m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz
    b = m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz
    c = m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz
    if not (abs(a) < 1 and abs(b) < 1 and abs(c) < 1):
        return False
    _sample(field.voxels[k], a, b, c, value)
    return True


@numba.njit(cache=True, nogil=True)
def _sample(voxels, a, b, c, value):  # pragma: no cover (compiled)
    """Write colour and windowed density at (a, b, c) in [-1, 1]^3 to `value`, interpolated between voxels."""
    size = voxels.shape[0]
    half = 0.5 * (size - 1)
    fa, fb, fc = (a + 1) * half, (b + 1) * half, (c + 1) * half
    ia, ib, ic = min(max(int(fa), 0), size - 2), min(max(int(fb), 0), size - 2), min(max(int(fc), 0), size - 2)
    ta, tb, tc = fa - ia, fb - ib, fc - ic
    red, green, blue, density = 0.0, 0.0, 0.0, 0.0
    for corner in range(8):
        p, q, r = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (ta if p else 1 - ta) * (tb if q else 1 - tb) * (tc if r else 1 - tc)
        voxel = voxels[ic + r, ib + q, ia + p]
        red += weight * voxel[0]
        green += weight * voxel[1]
        blue += weight * voxel[2]
        density += weight * voxel[3]
    window = math.exp(-_SHARPNESS * (a**_POWER + b**_POWER + c**_POWER))
    value[0], value[1], value[2], value[3] = red, green, blue, density * window


@numba.njit(cache=True, nogil=True)
def _density(field, points):  # pragma: no cover (compiled)
    out = np.zeros(len(points), np.float32)
    value = np.empty(4)
    for n in range(len(points)):
        x, y, z = points[n]
        cell = _cell_of(field, x, y, z)
        if cell < 0:
            continue
        total = 0.0
        for place in range(field.start[cell], field.start[cell + 1]):
            if _in_box(field, field.box[place], x, y, z, value):
                total += value[3]
        out[n] = total
    return out


@numba.njit(cache=True, nogil=True)
def _march(field, origins, directions, steps, step):  # pragma: no cover (compiled)
    rgb = np.zeros((len(origins), 3), np.float32)
    alpha = np.zeros(len(origins), np.float32)
    last_ray = np.full(len(field.position), -1)  # that met each box
    boxes, met = np.empty((len(field.position), 9)), np.empty(len(field.position), np.int64)
    value = np.empty(4)
    for n in range(len(origins)):
        count, cell_before = 0, -1
        for i in range(steps):
            t = (i + 0.5) * step
            x, y = origins[n, 0] + t * directions[n, 0], origins[n, 1] + t * directions[n, 1]
            cell = _cell_of(field, x, y, origins[n, 2] + t * directions[n, 2])
            if cell < 0 or cell == cell_before:
                continue
            cell_before = cell
            for place in range(field.start[cell], field.start[cell + 1]):
                k = field.box[place]
                if last_ray[k] != n:
                    last_ray[k] = n
                    if _crossed(field, k, origins[n], directions[n], boxes[count]):
                        met[count] = k
                        count += 1
        seen, r, g, b = 0.0, 0.0, 0.0, 0.0
        for i in range(steps):
            t = (i + 0.5) * step
            density, red, green, blue = 0.0, 0.0, 0.0, 0.0
            for j in range(count):
                box = boxes[j]
                if box[6] < t < box[7]:
                    a, b_, c = box[0] + t * box[3], box[1] + t * box[4], box[2] + t * box[5]
                    _sample(field.voxels[met[j]], a, b_, c, value)
                    density += value[3]
                    red += value[3] * value[0]
                    green += value[3] * value[1]
                    blue += value[3] * value[2]
            if density <= 0:
                continue
            part = min(density * step, 1 - seen) / density
            seen += density * part
            r, g, b = r + part * red, g + part * green, b + part * blue
            if seen >= 1:
                break
        alpha[n] = seen
        if seen > 0:
            rgb[n, 0], rgb[n, 1], rgb[n, 2] = r / seen, g / seen, b / seen
    return rgb, alpha


@numba.njit(cache=True, nogil=True)
def _crossed(field, k, origin, direction, box):  # pragma: no cover (compiled)
    """Write a ray in the axes of box k to `box`: origin, direction, and where it enters and leaves; whether it does."""
    box[6], box[7] = -np.inf, np.inf
    for axis in range(3):
        row = field.to_local[k, axis]
        box[axis] = box[3 + axis] = 0.0
        for i in range(3):
            box[axis] += row[i] * (origin[i] - field.position[k, i])
            box[3 + axis] += row[i] * direction[i]
        if box[3 + axis] == 0:
            if abs(box[axis]) >= 1:
                return False
            continue
        one, other = (-1 - box[axis]) / box[3 + axis], (1 - box[axis]) / box[3 + axis]
        box[6], box[7] = max(box[6], min(one, other)), min(box[7], max(one, other))
    return box[6] < box[7] and box[7] > 0


@numba.njit(cache=True, nogil=True)
def _weights(field, points, box_weights):  # pragma: no cover (compiled)
    out = np.zeros((len(points), box_weights.shape[1]), np.float32)
    value = np.empty(4)
    for n in range(len(points)):
        x, y, z = points[n]
        cell = _cell_of(field, x, y, z)
        if cell < 0:
            continue
        nearest = np.inf
        for place in range(field.start[cell], field.start[cell + 1]):
            k = field.box[place]
            if _in_box(field, k, x, y, z, value) and value[3] > 0:
                nearest = min(nearest, _squared(field.position[k], x, y, z))
        total = 0.0
        for place in range(field.start[cell], field.start[cell + 1]):
            k = field.box[place]
            if _in_box(field, k, x, y, z, value) and value[3] > 0:
                share = value[3] * math.exp((nearest - _squared(field.position[k], x, y, z)) / NEAREST**2)
                total += share
                for joint in range(box_weights.shape[1]):
                    out[n, joint] += share * box_weights[k, joint]
        if total > 0:
            out[n] /= total
    return out


@numba.njit(cache=True, nogil=True)
def _squared(position, x, y, z):  # pragma: no cover (compiled)
    return (x - position[0]) ** 2 + (y - position[1]) ** 2 + (z - position[2]) ** 2
