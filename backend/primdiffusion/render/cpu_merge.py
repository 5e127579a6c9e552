"""Boxes summed into one grid of voxels: the compiled loop of `merge`."""

from __future__ import annotations

import math

import numpy as np

from primdiffusion.primitives.primitives import WINDOW_POWER, WINDOW_SHARPNESS
from primdiffusion.render.cpu_compiled import kernel, take

_HALF_POWER = WINDOW_POWER // 2


@kernel
def sum_boxes(taken, position, to_local, low, high, voxels, origin, voxel, points, density, colour):
    """Adds every box to density [X, Y, Z] and colour [X, Y, Z, 3] (weighted by density), a slice along x at a time.

    to_local [K, 3, 3] takes x - position to y in [-1, 1]^3; low and high [K, 3] are the indices that a box reaches,
    high exclusive; voxels [K, D, H, W, 4] red, green, blue, density. A voxel is the mean of points^3 places in it.
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
