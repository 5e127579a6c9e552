"""The fast marcher for CPUs: numba, float32, no gradients; the same rule as `reference.py` (SPEC 4).

Pixels are worked on in tiles of 16 x 16, each with the list of boxes whose projected corners touch it. A ray finds the
lattice points at which it enters and leaves each box, then gathers opacity and colour over a chunk of lattice points,
composites the chunk, and stops when it is opaque.
"""

from __future__ import annotations

import math
import threading

import numba
import numpy as np
import torch
from jaxtyping import Int64
from numpy import ndarray

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.compositing import SURFACE_OPACITY, Rendering
from primdiffusion.render.lattice import WINDOW_SHARPNESS, MarchSettings, check_scene, check_unbatched, strides_of
from primdiffusion.render.tiles import TILE, tile_lists

# numba's disk cache watches this file only: touch it after changing a constant that is imported above.
CHUNK = 32
"""Lattice points gathered before they are composited: long enough to amortise the loop, short enough to stop early."""

_ONE_AT_A_TIME = threading.Lock()
"""numba's built-in thread pool, all there is on some systems, ends the process when two threads use it at once."""


def march_cpu(primitives: Primitives, camera: Camera, settings: MarchSettings = MarchSettings()) -> Rendering:  # noqa: B008
    """As `march_reference`, in float32 on the CPU with all of numba's threads; not differentiable.

    Ray-box geometry is computed in float64, samples in float32. The first call on a machine compiles (some 10 s); the
    result is cached on disk. Raises ValueError as `check_scene` does.
    """
    check_scene(primitives, camera)
    check_unbatched(primitives, camera)
    solid = (primitives.half_extent > 0).all(-1).nonzero()[:, 0]
    boxes = primitives.map(lambda tensor: tensor.detach().cpu()[solid])
    stride = strides_of(boxes, settings).numpy()
    origin, directions = (value.detach().cpu().double() for value in camera.rays())

    inverse = (1 / boxes.half_extent.double()).numpy()
    to_local = boxes.rotation.double().numpy().transpose(0, 2, 1) * inverse[:, :, None]
    start = np.einsum("kij,kj->ki", to_local, origin.numpy() - boxes.position.double().numpy())
    voxels = torch.cat([boxes.rgb, boxes.density[:, None]], dim=1).movedim(1, -1).float().contiguous().numpy()

    tile_start, tile_box = tile_lists(boxes, camera)
    picture = np.zeros((camera.height, camera.width, 6), np.float32)
    order = _dealt(tile_start)
    rays, spacing = directions.numpy(), settings.spacing
    with _ONE_AT_A_TIME:
        _march_tiles(picture, rays, to_local, start, voxels, stride, tile_start, tile_box, order, spacing)
    rgb, alpha, depth, first_hit = torch.from_numpy(picture).split((3, 1, 1, 1), dim=-1)
    return Rendering(rgb.contiguous(), *(field[..., 0].contiguous() for field in (alpha, depth, first_hit)))


def _dealt(tile_start: Int64[ndarray, "tiles+1"]) -> Int64[ndarray, "tiles"]:
    """An order of the tiles in which each thread's contiguous share has about the same number of boxes to look at."""
    threads = numba.get_num_threads()
    heavy_first = np.argsort(-np.diff(tile_start), kind="stable")
    return np.concatenate([heavy_first[thread::threads] for thread in range(threads)])


@numba.njit(parallel=True, cache=True, fastmath={"contract", "arcp", "nsz", "afn"})
def _march_tiles(picture, directions, to_local, start, voxels, stride, tile_start, tile_box, order, spacing):
    height, width = picture.shape[:2]
    across = (width + TILE - 1) // TILE
    for i in numba.prange(len(order)):
        tile = order[i]
        boxes = tile_box[tile_start[tile] : tile_start[tile + 1]]
        hit_box = np.empty(len(boxes), np.int64)
        hit_first = np.empty(len(boxes), np.int64)
        hit_last = np.empty(len(boxes), np.int64)
        chunk = np.empty((CHUNK, 4), np.float32)
        row0, column0 = (tile // across) * TILE, (tile % across) * TILE
        for row in range(row0, min(row0 + TILE, height)):
            for column in range(column0, min(column0 + TILE, width)):
                direction = directions[row, column]
                hits = _find_hits(hit_box, hit_first, hit_last, direction, boxes, to_local, start, stride, spacing)
                _march_ray(
                    picture[row, column], chunk, hit_box[:hits], hit_first[:hits], hit_last[:hits],
                    direction, to_local, start, voxels, stride, spacing,
                )  # fmt: skip


@numba.njit(cache=True, fastmath={"contract", "arcp", "nsz"})
def _find_hits(hit_box, hit_first, hit_last, direction, boxes, to_local, start, stride, spacing):
    """The boxes a ray meets with their first and last lattice points, sorted by the first; how many there are."""
    hits = 0
    for k in boxes:
        enter, leave = 0.0, np.inf
        for axis in range(3):
            p, q = start[k, axis], _dot(to_local[k, axis], direction)
            if abs(q) < 1e-12:
                q = 1e-12
            inverse = 1.0 / q
            middle, half = -p * inverse, abs(inverse)
            enter, leave = max(enter, middle - half), min(leave, middle + half)
        if leave <= enter:
            continue
        step = spacing * stride[k]
        first, last = max(math.ceil(enter / step), 1) * stride[k], math.floor(leave / step) * stride[k]
        if first > last:
            continue
        place = hits
        while place > 0 and hit_first[place - 1] > first:
            before = place - 1
            hit_box[place], hit_first[place], hit_last[place] = hit_box[before], hit_first[before], hit_last[before]
            place -= 1
        hit_box[place], hit_first[place], hit_last[place] = k, first, last
        hits += 1
    return hits


@numba.njit(cache=True, fastmath={"contract", "arcp", "nsz", "afn"})
def _march_ray(pixel, chunk, hit_box, hit_first, hit_last, direction, to_local, start, voxels, stride, spacing):
    """Composites the boxes of one ray into pixel = (red, green, blue, alpha, depth, first hit)."""
    red, green, blue, alpha, moment = 0.0, 0.0, 0.0, 0.0, 0.0
    first_hit = np.inf
    done = 0  # hits before this one end before the chunk
    begin = 0
    while done < len(hit_box) and alpha < 1.0:
        begin = max(begin, hit_first[done])
        end = begin + CHUNK
        chunk[:] = 0
        for hit in range(done, len(hit_box)):
            if hit_first[hit] >= end:
                break
            if hit_last[hit] >= begin:
                k = hit_box[hit]
                first = max(hit_first[hit], (begin + stride[k] - 1) // stride[k] * stride[k])
                last = min(hit_last[hit], end - 1)
                _gather(chunk, begin, first, last, k, direction, to_local, start, voxels, stride, spacing)
        for slot in range(CHUNK):
            opacity = chunk[slot, 3]
            if opacity > 0:
                weight = min(float(opacity), 1.0 - alpha)
                share = weight / opacity
                red += share * chunk[slot, 0]
                green += share * chunk[slot, 1]
                blue += share * chunk[slot, 2]
                distance = (begin + slot) * spacing
                moment += weight * distance
                alpha += weight
                if first_hit == np.inf and alpha >= SURFACE_OPACITY:
                    first_hit = distance
                if weight < opacity:
                    alpha = 1.0
                    break
        begin = end
        while done < len(hit_box) and hit_last[done] < begin:
            done += 1
    pixel[0], pixel[1], pixel[2], pixel[3] = red, green, blue, alpha
    pixel[4] = moment / alpha if alpha > 0 else np.inf
    pixel[5] = first_hit


@numba.njit(cache=True, fastmath={"contract", "arcp", "nsz", "afn"})
def _gather(chunk, begin, first, last, k, direction, to_local, start, voxels, stride, spacing):
    """Adds box k's samples at lattice points first, first + stride, ..., last to the chunk: a * colour and a."""
    size = voxels.shape[1]
    one, half_range, last_cell = np.float32(1), np.float32(0.5 * (size - 1)), np.int32(size - 2)
    sharpness, length = np.float32(-WINDOW_SHARPNESS), np.float32(stride[k] * spacing)
    x, y, z = _local(direction, first * spacing, to_local, start, k)
    x_next, y_next, z_next = _local(direction, (first + stride[k]) * spacing, to_local, start, k)
    dx, dy, dz = x_next - x, y_next - y, z_next - z
    box = voxels[k]
    for i in range((last - first) // stride[k] + 1):
        along = np.float32(i)
        lx, ly, lz = x + along * dx, y + along * dy, z + along * dz
        u, v, w = (lx + one) * half_range, (ly + one) * half_range, (lz + one) * half_range
        iu = min(max(np.int32(u), np.int32(0)), last_cell)
        iv = min(max(np.int32(v), np.int32(0)), last_cell)
        iw = min(max(np.int32(w), np.int32(0)), last_cell)
        fu, fv, fw = u - np.float32(iu), v - np.float32(iv), w - np.float32(iw)
        gu, gv, gw = one - fu, one - fv, one - fw
        a0, b0, c0 = np.uint32(iu), np.uint32(iv), np.uint32(iw)
        a1, b1, c1 = np.uint32(iu + 1), np.uint32(iv + 1), np.uint32(iw + 1)
        d00 = box[c0, b0, a0, 3] * gu + box[c0, b0, a1, 3] * fu
        d01 = box[c0, b1, a0, 3] * gu + box[c0, b1, a1, 3] * fu
        d10 = box[c1, b0, a0, 3] * gu + box[c1, b0, a1, 3] * fu
        d11 = box[c1, b1, a0, 3] * gu + box[c1, b1, a1, 3] * fu
        density = (d00 * gv + d01 * fv) * gw + (d10 * gv + d11 * fv) * fw
        if density == 0:  # the outer part of a person's boxes is empty
            continue
        x4, y4, z4 = lx * lx * lx * lx, ly * ly * ly * ly, lz * lz * lz * lz
        opacity = density * math.exp(sharpness * (x4 * x4 + y4 * y4 + z4 * z4)) * length
        slot = np.uint32(first + i * stride[k] - begin)
        for channel in range(3):
            e00 = box[c0, b0, a0, channel] * gu + box[c0, b0, a1, channel] * fu
            e01 = box[c0, b1, a0, channel] * gu + box[c0, b1, a1, channel] * fu
            e10 = box[c1, b0, a0, channel] * gu + box[c1, b0, a1, channel] * fu
            e11 = box[c1, b1, a0, channel] * gu + box[c1, b1, a1, channel] * fu
            chunk[slot, channel] += opacity * ((e00 * gv + e01 * fv) * gw + (e10 * gv + e11 * fv) * fw)
        chunk[slot, 3] += opacity


@numba.njit(cache=True)
def _local(direction, distance, to_local, start, k):
    """A point of the ray in box k's coordinates; rounded to float32 only after large terms have cancelled."""
    x = start[k, 0] + distance * _dot(to_local[k, 0], direction)
    y = start[k, 1] + distance * _dot(to_local[k, 1], direction)
    z = start[k, 2] + distance * _dot(to_local[k, 2], direction)
    return np.float32(x), np.float32(y), np.float32(z)


@numba.njit(cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
