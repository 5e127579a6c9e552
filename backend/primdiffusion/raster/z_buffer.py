"""The z-buffer: the nearest triangle behind the centre of each pixel.

A corner in front of the near plane is projected to pixel coordinates (x, y, 1). A corner behind it keeps its
homogeneous image coordinates, so a triangle that crosses the plane needs no clipping (Olano and Greer 1997, "Triangle
Scan Conversion using 2D Homogeneous Coordinates"). Relative to a pixel centre, the edge functions of a triangle are the
cross products of its corners; they have one sign inside and are proportional to the barycentric coordinates. Two
triangles that share an edge get exactly opposite values for it, so no pixel falls between them.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Float, Float32, Float64, Int32
from numpy import ndarray

from primdiffusion.geometry.camera import Camera
from primdiffusion.raster.textures import NO_TEXTURES, Textures, alpha_at

CLOSEST = 1e-6
"""Nearest depth at which a triangle is drawn, metres."""
SMALLEST_AREA = 1e-12
"""Square pixels; smaller triangles are skipped."""
NARROWED = 12
"""Triangles wider than this many columns are narrowed row by row to the columns between their edges."""


@dataclasses.dataclass(frozen=True, eq=False)
class NearestTriangle:
    """The surface seen at each pixel centre."""

    triangle: Int32[ndarray, "h w"]
    """Index of the triangle, -1 if there is none."""
    depth: Float32[ndarray, "h w"]
    """Metres along the optical axis; inf if there is none."""


@dataclasses.dataclass(frozen=True, eq=False)
class AlphaTest:
    """The textures whose transparent texels are holes in the triangles."""

    corner_uv: Float32[ndarray, "f 3 2"]
    part: Int32[ndarray, "f"]
    """Index of a triangle's texture."""
    textures: Textures
    """Alpha is interpolated between texels."""


NO_TEST = AlphaTest(np.zeros((0, 3, 2), np.float32), np.zeros(0, np.int32), NO_TEXTURES)


def project(
    in_camera: Float64[ndarray, "v 3"], intrinsics: Float64[ndarray, "3 3"], near: float
) -> Float64[ndarray, "v 4"]:
    """Homogeneous image points (x, y, w) and their scale; w = 1 and scale = 1 / depth in front of `near`."""
    depth = in_camera[:, 2]
    in_front = depth >= near
    scale = np.where(in_front, 1 / np.maximum(depth, near), 1.0)
    points = np.empty((len(in_camera), 4))
    points[:, :2] = (in_camera @ intrinsics.T)[:, :2] * scale[:, None]
    points[:, 2] = np.where(in_front, 1.0, depth)
    points[:, 3] = scale
    return points


def nearest_triangles(
    corners: Float[ndarray, "f 3 3"], camera: Camera, clip: tuple[float, float] = (0.0, np.inf)
) -> NearestTriangle:
    """The nearest triangle of each pixel, from both sides; of several at one depth the first.

    Triangles are cut at the depths `clip`, metres along the optical axis. Triangles without area are skipped.
    """
    intrinsics = camera.intrinsics.detach().cpu().double().numpy()
    view = camera.world_to_camera.detach().cpu().double().numpy()
    near = max(clip[0], CLOSEST)
    points = np.empty((3 * len(corners), 4))
    _project_corners(np.ascontiguousarray(corners), intrinsics @ view[:, :3], intrinsics @ view[:, 3], near, points)
    faces = np.arange(len(points), dtype=np.int32).reshape(-1, 3)
    return z_buffer(points, faces, camera.height, camera.width, (near, clip[1]))


def z_buffer(
    points: Float64[ndarray, "v 4"],
    faces: Int32[ndarray, "f 3"],
    height: int,
    width: int,
    clip: tuple[float, float],
    *,
    parallel: bool = False,
    slack: float = 0.0,
    alpha_test: AlphaTest = NO_TEST,
) -> NearestTriangle:
    """The nearest triangle of each pixel whose depth lies within `clip`; of several at one depth the first.

    Args:
        points: see `project`; for parallel rays the columns are x, y, 1 and depth.
        slack: how far outside a triangle, in barycentric coordinates, a pixel centre still counts as inside.
    """
    nearest = NearestTriangle(np.full((height, width), -1, np.int32), np.full((height, width), np.inf, np.float32))
    textures = alpha_test.textures
    _rasterise(
        points, faces, float(clip[0]), float(clip[1]), parallel, slack, alpha_test.corner_uv, alpha_test.part,
        textures.rgba, textures.start, textures.size, textures.cut_out, nearest.triangle, nearest.depth,
    )  # fmt: skip
    return nearest


def barycentrics(
    points: Float64[ndarray, "v 4"],
    faces: Int32[ndarray, "f 3"],
    triangle: Int32[ndarray, "h w"],
    parallel: bool,
    dtype: type[np.floating],
) -> Float[ndarray, "h w 3"]:
    """Perspective-correct barycentric coordinates of the pixel centres on their triangles; 0 where there is none."""
    found = np.zeros((*triangle.shape, 3), dtype)
    _locate(points, faces, parallel, triangle, found)
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rasterise(
    points, faces, near, far, parallel, slack, corner_uv, part, rgba, start, size, cut_out, triangle, depth
):  # fmt: skip
    height, width = triangle.shape
    for f in range(len(faces)):
        p, q, r = _corner(points, faces[f, 0]), _corner(points, faces[f, 1]), _corner(points, faces[f, 2])
        left, right, top, bottom = _bounds(p, q, r, near, height, width)
        if left > right or top > bottom:
            continue
        area = _area(p, q, r)
        if abs(area) < SMALLEST_AREA:
            continue
        sign = 1.0 if area > 0.0 else -1.0
        least = -slack * abs(area)
        tested = len(cut_out) > 0 and cut_out[part[f]]
        for row in range(top, bottom + 1):
            y = row + 0.5
            first, last = left, right
            if right - left > NARROWED:
                first, last = _narrowed(first, last, q, r, y, sign, least)
                first, last = _narrowed(first, last, r, p, y, sign, least)
                first, last = _narrowed(first, last, p, q, y, sign, least)
            for column in range(first, last + 1):
                edges = _edges(p, q, r, column + 0.5, y)
                if sign * edges[0] < least or sign * edges[1] < least or sign * edges[2] < least:
                    continue
                a, b, c, z = _weights(edges, area, p, q, r, parallel)
                if not near <= z <= far or not np.float32(z) < depth[row, column]:
                    continue
                if tested:
                    u = a * corner_uv[f, 0, 0] + b * corner_uv[f, 1, 0] + c * corner_uv[f, 2, 0]
                    v = a * corner_uv[f, 0, 1] + b * corner_uv[f, 1, 1] + c * corner_uv[f, 2, 1]
                    n = part[f]
                    if alpha_at(u, v, rgba, start[n, 0], size[n, 0, 0], size[n, 0, 1]) < 127.5:
                        continue
                depth[row, column] = z
                triangle[row, column] = f


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _locate(points, faces, parallel, triangle, found):
    for row in range(triangle.shape[0]):
        for column in range(triangle.shape[1]):
            f = triangle[row, column]
            if f < 0:
                continue
            p, q, r = _corner(points, faces[f, 0]), _corner(points, faces[f, 1]), _corner(points, faces[f, 2])
            edges = _edges(p, q, r, column + 0.5, row + 0.5)
            a, b, c, _ = _weights(edges, _area(p, q, r), p, q, r, parallel)
            found[row, column, 0], found[row, column, 1], found[row, column, 2] = a, b, c


@numba.njit(cache=True, nogil=True)
def _project_corners(corners, linear, shift, near, points):
    """Same as `project`, in one pass over millions of corners in the world."""
    for f in range(len(corners)):
        for corner in range(3):
            x, y, z = corners[f, corner, 0], corners[f, corner, 1], corners[f, corner, 2]
            depth = linear[2, 0] * x + linear[2, 1] * y + linear[2, 2] * z + shift[2]
            scale = 1.0 / depth if depth >= near else 1.0
            point = points[3 * f + corner]
            for axis in range(2):
                point[axis] = (linear[axis, 0] * x + linear[axis, 1] * y + linear[axis, 2] * z + shift[axis]) * scale
            point[2] = 1.0 if depth >= near else depth
            point[3] = scale


@numba.njit(cache=True, nogil=True)
def _corner(points, index):
    return points[index, 0], points[index, 1], points[index, 2], points[index, 3]


@numba.njit(cache=True, nogil=True)
def _edges(p, q, r, x, y):
    """Edge functions opposite each corner at the image point (x, y)."""
    px, py, qx, qy = p[0] - x * p[2], p[1] - y * p[2], q[0] - x * q[2], q[1] - y * q[2]
    rx, ry = r[0] - x * r[2], r[1] - y * r[2]
    return qx * ry - rx * qy, rx * py - px * ry, px * qy - qx * py


@numba.njit(cache=True, nogil=True)
def _area(p, q, r):
    """Determinant of the corners: the edge function opposite a projected corner, at that corner."""
    if p[2] == 1.0:
        return _edges(p, q, r, p[0], p[1])[0]
    if q[2] == 1.0:
        return _edges(p, q, r, q[0], q[1])[1]
    return _edges(p, q, r, r[0], r[1])[2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weights(edges, area, p, q, r, parallel):
    """Barycentric coordinates and depth."""
    a, b, c = edges[0] / area, edges[1] / area, edges[2] / area
    if parallel:
        return a, b, c, a * p[3] + b * q[3] + c * r[3]
    a, b, c = a * p[3], b * q[3], c * r[3]
    z = 1.0 / (a + b + c)
    return a * z, b * z, c * z, z


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _narrowed(first, last, p, q, y, sign, least):
    """Columns of row y where the edge function of p and q may reach `least`; one more at either end for rounding."""
    py, qy = p[1] - y * p[2], q[1] - y * q[2]
    slope, offset = sign * (q[2] * py - p[2] * qy), sign * (p[0] * qy - q[0] * py) - least
    if slope == 0.0:
        return first, last
    root = -offset / slope - 0.5
    if slope > 0.0:
        return max(first, int(np.ceil(max(root, -1.0))) - 1) if root < last + 1.0 else last + 1, last
    return first, min(last, int(np.floor(max(root, -2.0))) + 1) if root < last + 1.0 else last


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bounds(p, q, r, near, height, width):
    """First and last column, first and last row of the part of a triangle in front of the near plane."""
    if p[2] == 1.0 and q[2] == 1.0 and r[2] == 1.0:
        low_x, high_x = min(p[0], q[0], r[0]), max(p[0], q[0], r[0])
        low_y, high_y = min(p[1], q[1], r[1]), max(p[1], q[1], r[1])
    else:
        low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
        for corner, other in ((p, q), (q, r), (r, p)):
            if corner[2] == 1.0:
                low_x, high_x = min(low_x, corner[0]), max(high_x, corner[0])
                low_y, high_y = min(low_y, corner[1]), max(high_y, corner[1])
            if (corner[2] == 1.0) != (other[2] == 1.0):
                z, other_z = corner[2] / corner[3], other[2] / other[3]
                share = (near - z) / (other_z - z)
                x = (corner[0] / corner[3] + share * (other[0] / other[3] - corner[0] / corner[3])) / near
                y = (corner[1] / corner[3] + share * (other[1] / other[3] - corner[1] / corner[3])) / near
                # One pixel more on each side, because these points are rounded.
                low_x, high_x = min(low_x, x - 1.0), max(high_x, x + 1.0)
                low_y, high_y = min(low_y, y - 1.0), max(high_y, y + 1.0)
    if not (high_x > 0.0 and high_y > 0.0 and low_x < width and low_y < height):
        return 1, 0, 1, 0
    return (
        int(np.ceil(max(low_x - 0.5, 0.0))), int(np.floor(min(high_x - 0.5, width - 1.0))),
        int(np.ceil(max(low_y - 0.5, 0.0))), int(np.floor(min(high_y - 0.5, height - 1.0))),
    )  # fmt: skip
