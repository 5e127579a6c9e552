"""Merge all boxes into one voxel grid for renderers with exponential absorption."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from primdiffusion.formats.requests import VOXEL
from primdiffusion.primitives.primitives import WINDOW_POWER, WINDOW_SHARPNESS, Primitives
from primdiffusion.render.cpu.compiled import kernel, on_all_threads, take

_HALF_POWER = WINDOW_POWER // 2


@kernel
def sum_boxes(taken, position, to_local, low, high, voxels, origin, voxel, points, density, colour):
    """Add every box to density [X, Y, Z] and colour [X, Y, Z, 3] (weighted by density), slice by slice along x.

    to_local [K, 3, 3] maps x - position to y in [-1, 1]^3; low and high [K, 3] bound the indices of a box, high
    exclusive; voxels [K, D, H, W, 4] are red, green, blue, density. A voxel is the mean of points^3 samples in it.
    """
    share = 1.0 / (points * points * points)
    depth, rows, columns = voxels.shape[1], voxels.shape[2], voxels.shape[3]
    x = take(taken)
    while x < density.shape[0]:
        for k in range(len(position)):
            if not low[k, 0] <= x < high[k, 0]:
                continue
            m = to_local[k]
            for y in range(low[k, 1], high[k, 1]):
                for z in range(low[k, 2], high[k, 2]):
                    for p in range(points * points * points):
                        sx, sy, sz = p // (points * points), p // points % points, p % points
                        dx = origin[0] + (x + (sx + 0.5) / points - 0.5) * voxel - position[k, 0]
                        dy = origin[1] + (y + (sy + 0.5) / points - 0.5) * voxel - position[k, 1]
                        dz = origin[2] + (z + (sz + 0.5) / points - 0.5) * voxel - position[k, 2]
                        u = m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz
                        v = m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz
                        w = m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz
                        if not (abs(u) < 1.0 and abs(v) < 1.0 and abs(w) < 1.0):
                            continue
                        faded = share * math.exp(
                            -WINDOW_SHARPNESS
                            * ((u * u) ** _HALF_POWER + (v * v) ** _HALF_POWER + (w * w) ** _HALF_POWER)
                        )
                        i, j, o = (w + 1) / 2 * (depth - 1), (v + 1) / 2 * (rows - 1), (u + 1) / 2 * (columns - 1)
                        i0, j0, o0 = int(i), int(j), int(o)
                        red, green, blue, opacity = 0.0, 0.0, 0.0, 0.0
                        for corner in range(8):
                            a, b, c = corner // 4, corner // 2 % 2, corner % 2
                            weight = abs(1 - a - i + i0) * abs(1 - b - j + j0) * abs(1 - c - o + o0)
                            value = voxels[k, min(i0 + a, depth - 1), min(j0 + b, rows - 1), min(o0 + c, columns - 1)]
                            red += weight * value[0]
                            green += weight * value[1]
                            blue += weight * value[2]
                            opacity += weight * value[3]
                        opacity *= faded
                        density[x, y, z] += np.float32(opacity)
                        colour[x, y, z, 0] += np.float32(opacity * red)
                        colour[x, y, z, 1] += np.float32(opacity * green)
                        colour[x, y, z, 2] += np.float32(opacity * blue)
        x = take(taken)


POINTS = 2
"""Samples along each side of a voxel."""
MOST_VOXELS = 2**27
"""Limit for a grid: 2 GB. A human 1.8 m tall takes 5 million at 6 mm."""
FULLEST = 1.0
"""Largest opacity of a voxel along its side. More is invisible in the additive, clamped rule, and interpolation would
spread it to neighbouring empty voxels."""
FAINTEST = 0.05
"""Opacity per metre below which a voxel is empty."""


@dataclasses.dataclass(frozen=True)
class Merged:
    """A voxel grid in the axes of the primitives, empty outside."""

    density: Float[ndarray, "x y z"]
    """Opacity per metre, including the window and all overlapping primitives; float32."""
    colour: Float[ndarray, "x y z 3"]
    """Linear RGB; empty voxels take the colour of their neighbours, so that interpolation does not darken edges."""
    origin: Float[ndarray, "3"]
    """Centre of voxel [0, 0, 0], metres; a multiple of the voxel size, so that all poses share a lattice."""
    voxel: float
    """Voxel size, metres."""


def merge(primitives: Primitives, voxel: float = VOXEL, points: int = POINTS) -> Merged:
    """Merge `primitives` (unbatched) into one grid.

    A voxel's density is the mean of sum_i d_i w_i over points^3 samples in it (d: trilinear density, w: window;
    SPEC 4), at most FULLEST / voxel; its colour is sum d_i w_i c_i / sum d_i w_i, as in the additive rule. Boxes with
    an extent of zero or less are ignored. Not differentiable. Raises ValueError for a batch, and if the voxel size is
    not positive or the grid would exceed MOST_VOXELS.
    """
    if primitives.density.ndim != 4:
        raise ValueError(
            f"the primitives are a batch {tuple(primitives.density.shape[:-4])}: merge one human at a time"
        )
    if not voxel > 0:
        raise ValueError(f"the voxel is {voxel} m: give a size above zero")
    boxes = _boxes(primitives)
    position, rotation, half = boxes.position, boxes.rotation, boxes.half_extent
    middle = position + (rotation @ (half * (boxes.low + boxes.high) / 2)[..., None])[..., 0]
    reach = (np.abs(rotation) @ (half * (boxes.high - boxes.low) / 2)[..., None])[..., 0]
    low = np.floor((middle - reach) / voxel).astype(np.int64)
    high = np.ceil((middle + reach) / voxel).astype(np.int64) + 1
    first = low.min(0) - 1 if len(low) else np.zeros(3, np.int64)
    shape = tuple((high.max(0) - first + 1).tolist()) if len(low) else (1, 1, 1)
    if np.prod(shape, dtype=np.float64) > MOST_VOXELS:
        fitting = voxel * float(np.prod(shape, dtype=np.float64) / MOST_VOXELS) ** (1 / 3)
        raise ValueError(
            f"voxels of {voxel * 1000:.3g} mm make a grid of {shape}: choose {fitting * 1000:.2g} mm or more"
        )
    density, colour = np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32)
    to_local = np.swapaxes(rotation, -1, -2) / half[..., None]
    on_all_threads(
        sum_boxes, position, to_local, low - first, high - first, boxes.voxels, first * voxel, voxel, points,
        density, colour,
    )  # fmt: skip
    return Merged(*_finished(density, colour, FULLEST / voxel), first * voxel, voxel)


class _Boxes(NamedTuple):
    """Boxes that are not empty, in float64; y in [-1, 1]^3 are coordinates in a box."""

    position: ndarray
    rotation: ndarray
    half_extent: ndarray
    low: ndarray
    """Lower bound of the density in y [K, 3]; most boxes are empty outside the skin."""
    high: ndarray
    voxels: ndarray
    """[K, D, H, W, 4]: red, green, blue, density; float32."""


def _boxes(primitives: Primitives) -> _Boxes:
    solid = (primitives.half_extent > 0).all(-1) & (primitives.density > 0).flatten(-3).any(-1)
    density = primitives.density[solid]
    voxels = torch.cat([primitives.rgb[solid], density[:, None]], 1).movedim(1, -1).float().contiguous()
    position, rotation, half = (
        getattr(primitives, name)[solid].detach().double().cpu().numpy()
        for name in ("position", "rotation", "half_extent")
    )
    low, high = np.empty((2, len(density), 3))
    full = density.detach().cpu().numpy() > 0
    for axis in range(3):
        row = full.any(tuple(1 + other for other in range(3) if other != 2 - axis))
        last = row.shape[1] - 1
        low[:, axis] = np.maximum(row.argmax(1) - 1, 0) / last * 2 - 1
        high[:, axis] = np.minimum(last - row[:, ::-1].argmax(1) + 1, last) / last * 2 - 1
    return _Boxes(position, rotation, half, low, high, voxels.detach().cpu().numpy())


def _finished(density: ndarray, colour: ndarray, fullest: float) -> tuple[ndarray, ndarray]:
    """Limit density, divide colour by it, and extend colour to neighbouring empty voxels."""
    empty = density < FAINTEST
    density[empty], colour[empty] = 0, 0
    weight, around = _around(density), _around(colour)
    near = empty & (weight > 0)
    colour[near] = around[near] / weight[near][:, None]
    colour[~empty] /= density[~empty][:, None]
    return np.minimum(density, np.float32(fullest)), colour


def _around(values: ndarray) -> ndarray:
    """Sums over the 3 x 3 x 3 neighbourhood of each voxel; the outermost voxels are empty."""
    for axis in range(3):
        moved = np.moveaxis(values, axis, 0)
        total = moved.copy()
        total[1:] += moved[:-1]
        total[:-1] += moved[1:]
        values = np.moveaxis(total, 0, axis)
    return values
