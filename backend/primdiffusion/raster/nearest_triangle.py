"""Which triangle each pixel sees first: what is opaque in a picture beside people, and their boxes drawn as boxes.

A ray through pixel (u, v) meets the triangle a, b, c (corners in camera space times the intrinsics, so that a pixel is
the direction (u, v, 1)) where e_a = (u, v, 1) . (b x c), e_b and e_c have one sign; its depth there is
a . (b x c) / (e_a + e_b + e_c). Nothing is divided by a corner's depth, so triangles that reach behind the camera need
no clipping (Olano and Greer 1997, "Triangle Scan Conversion using 2D Homogeneous Coordinates").
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Float, Float32, Int32
from numpy import ndarray

from primdiffusion.geometry.camera import Camera

CLOSEST = 1e-6
"""Metres in front of the camera's plane from which on anything is drawn."""


@dataclasses.dataclass(frozen=True, eq=False)
class NearestTriangle:
    """What is seen through each pixel's centre."""

    triangle: Int32[ndarray, "h w"]
    """Its number, -1 where there is none."""
    depth: Float32[ndarray, "h w"]
    """Metres along the optical axis; inf where there is none."""

    @classmethod
    def nothing(cls, camera: Camera) -> NearestTriangle:
        """A picture without triangles; read only."""
        size = (camera.height, camera.width)
        return cls(np.broadcast_to(np.int32(-1), size), np.broadcast_to(np.float32(np.inf), size))


def nearest_triangles(
    corners: Float[ndarray, "f 3 3"], camera: Camera, clip: tuple[float, float] = (0.0, np.inf)
) -> NearestTriangle:
    """The nearest triangle in each pixel, from both sides; of several at one depth the one of lowest number.

    Only what lies between the depths `clip` (metres along the optical axis) is seen: a triangle that crosses one of
    these planes is cut there. Triangles that share an edge leave no gap. Those without area are not seen.
    """
    k = camera.intrinsics.detach().cpu().double().numpy()
    view = camera.world_to_camera.detach().cpu().double().numpy()
    start, end = max(clip[0], CLOSEST), clip[1]
    nothing = NearestTriangle.nothing(camera)
    nearest = NearestTriangle(nothing.triangle.copy(), nothing.depth.copy())
    linear, shift = k @ view[:, :3], k @ view[:, 3]
    _draw(np.ascontiguousarray(corners), linear, shift, start, end, nearest.triangle, nearest.depth)
    return nearest


@numba.njit(cache=True, nogil=True)
def _draw(corners, linear, shift, start, end, triangle, depth):
    height, width = triangle.shape
    point = np.empty((3, 3))
    edge = np.empty((3, 3))
    for f in range(len(corners)):
        for corner in range(3):
            x, y, z = corners[f, corner, 0], corners[f, corner, 1], corners[f, corner, 2]
            for axis in range(3):
                point[corner, axis] = linear[axis, 0] * x + linear[axis, 1] * y + linear[axis, 2] * z + shift[axis]
        left, right, top, bottom = _bounds(point, start, end, height, width)
        if left > right or top > bottom:
            continue
        for corner in range(3):
            _cross(point[(corner + 1) % 3], point[(corner + 2) % 3], edge[corner])
        volume = point[0, 0] * edge[0, 0] + point[0, 1] * edge[0, 1] + point[0, 2] * edge[0, 2]
        if volume == 0.0:
            continue
        if volume < 0.0:
            volume = -volume
            edge *= -1.0
        for row in range(top, bottom + 1):
            v = row + 0.5
            a0, b0, c0 = (edge[0, 1] * v + edge[0, 2], edge[1, 1] * v + edge[1, 2], edge[2, 1] * v + edge[2, 2])
            first, last = _narrowed(left, right, edge[0, 0], a0)
            first, last = _narrowed(first, last, edge[1, 0], b0)
            first, last = _narrowed(first, last, edge[2, 0], c0)
            for column in range(first, last + 1):
                u = column + 0.5
                a, b, c = edge[0, 0] * u + a0, edge[1, 0] * u + b0, edge[2, 0] * u + c0
                total = a + b + c
                if a < 0.0 or b < 0.0 or c < 0.0 or total <= 0.0:
                    continue
                z = volume / total
                if start <= z <= end and np.float32(z) < depth[row, column]:
                    depth[row, column] = z
                    triangle[row, column] = f


@numba.njit(cache=True, nogil=True)
def _narrowed(first, last, slope, offset):
    """The columns at which slope * u + offset may be >= 0; one more at either end, against rounding."""
    if slope == 0.0:
        return (first, last) if offset >= 0.0 else (1, 0)
    root = -offset / slope - 0.5
    if slope > 0.0:
        return max(first, int(np.ceil(max(root, -1.0))) - 1) if root < last + 1.0 else last + 1, last
    return first, min(last, int(np.floor(max(root, -2.0))) + 1) if root < last + 1.0 else last


@numba.njit(cache=True, nogil=True)
def _bounds(point, start, end, height, width):
    """First and last column, first and last row that the part of a triangle between the planes may reach."""
    nothing = (1, 0, 1, 0)
    low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
    nearest = min(point[0, 2], point[1, 2], point[2, 2])
    if max(point[0, 2], point[1, 2], point[2, 2]) < start or nearest > end or not nearest > -np.inf:
        return nothing
    for i in range(3):
        j = (i + 1) % 3
        x, y, z = point[i, 0], point[i, 1], point[i, 2]
        if z >= start:
            low_x, high_x = min(low_x, x / z), max(high_x, x / z)
            low_y, high_y = min(low_y, y / z), max(high_y, y / z)
        if (z >= start) != (point[j, 2] >= start):
            along = (start - z) / (point[j, 2] - z)
            x, y = (x + along * (point[j, 0] - x)) / start, (y + along * (point[j, 1] - y)) / start
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
    # A pixel more on each side: corners are projected with rounding of their own.
    if not (high_x > -1.0 and high_y > -1.0 and low_x < width + 1.0 and low_y < height + 1.0):
        return nothing
    left, right = int(max(low_x - 1.5, 0.0)), int(min(high_x + 0.5, width - 1.0))
    return left, right, int(max(low_y - 1.5, 0.0)), int(min(high_y + 0.5, height - 1.0))


@numba.njit(cache=True, nogil=True)
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
