"""Sample the visible surface of a mesh by rasterising it from several sides, and find nearest surface points."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from primdiffusion.raster.rasterise import Fragments, OrthographicView, TriangleSoup, draw, view_along

DIRECTIONS = (
    (0.0, 0.0, -1.0),
    (0.0, 0.0, 1.0),
    (-1.0, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0),
    (-1.0, -0.3, -1.0),
    (1.0, -0.3, -1.0),
    (-1.0, -0.3, 1.0),
    (1.0, -0.3, 1.0),
    (0.0, -1.0, -1.0),
    (0.0, -1.0, 1.0),
)
"""View directions. None looks up: from below, the space between jacket and trousers would be carved away, and hems
would become holes."""

PIXEL = 0.003
"""Pixel size of these views, metres."""

FACING = 0.5
"""Cosine of the largest angle to the normal at which a view decides whether a point is covered."""
COVER = (0.005, 0.030)
"""A surface whose distance above a point is in this range (metres) covers it: more than the depth uncertainty of the
views, less than the distance to the next limb."""


@dataclasses.dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of the outer surface visible in at least one view, about one per pixel area."""

    position: Float32[np.ndarray, "n 3"]
    """Metres."""
    normal: Float32[np.ndarray, "n 3"]
    """Unit length, towards the viewer."""
    face: Int32[np.ndarray, "n"]
    """Face of the soup."""
    barycentric: Float32[np.ndarray, "n 3"]
    """Barycentric coordinates on the face."""


def look_around(soup: TriangleSoup) -> tuple[list[OrthographicView], list[Fragments]]:
    """Rasterise the mesh along all DIRECTIONS."""
    used = soup.vertices[np.unique(soup.faces)]
    bounds = np.stack([used.min(0), used.max(0)])
    views = [view_along(direction, bounds, PIXEL) for direction in DIRECTIONS]
    return views, [draw(soup, view) for view in views]


def visible_points(soup: TriangleSoup, views: list[OrthographicView], drawn: list[Fragments]) -> SurfacePoints:
    """Visible points, thinned to one per cube of side PIXEL: the one that faces its view most directly."""
    corners = soup.vertices[soup.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    face = np.concatenate([fragments.face[fragments.face >= 0] for fragments in drawn])
    barycentric = np.concatenate([fragments.barycentric[fragments.face >= 0] for fragments in drawn])
    directions = np.repeat(
        np.stack([view.direction for view in views]), [int((fragments.face >= 0).sum()) for fragments in drawn], axis=0
    )
    towards = -np.einsum("ni,ni->n", normals[face], directions)
    position = np.einsum("ni,nij->nj", barycentric, corners[face])
    cell = np.floor((position - position.min(0)) / PIXEL).astype(np.int64)
    key = (cell[:, 0] << 42) + (cell[:, 1] << 21) + cell[:, 2]
    order = np.lexsort((-np.abs(towards), key))
    keep = order[np.concatenate([[True], np.diff(key[order]) != 0])]
    outward = normals[face[keep]] * np.where(towards[keep] < 0, -1.0, 1.0)[:, None]
    bare = ~_covered(position[keep], outward, views, drawn)
    if not bare.any():
        bare[:] = True
    keep, outward = keep[bare], outward[bare]
    return SurfacePoints(
        position=position[keep].astype(np.float32),
        normal=outward.astype(np.float32),
        face=face[keep],
        barycentric=barycentric[keep],
    )


def _covered(
    position: Float64[np.ndarray, "n 3"],
    normal: Float64[np.ndarray, "n 3"],
    views: list[OrthographicView],
    drawn: list[Fragments],
) -> Bool[np.ndarray, "n"]:
    """Mark points that lie closely under another surface, by the view that faces them most directly.

    A view down a collar sees skin under cloth, whose colour must not bleed into the cloth.
    """
    facing = -(normal @ np.stack([view.direction for view in views]).T)
    best = facing.argmax(1)
    covered = np.zeros(len(position), bool)
    for number, (view, fragments) in enumerate(zip(views, drawn, strict=True)):
        at = np.flatnonzero((best == number) & (facing[:, number] > FACING))
        in_view = position[at] @ view.world_to_view[:, :3].T + view.world_to_view[:, 3]
        column, row = (in_view[:, :2] / view.pixel_size).astype(np.int64).T
        gap = in_view[:, 2] - fragments.depth[row, column]
        covered[at] = (gap > COVER[0]) & (gap < COVER[1])
    return covered


@dataclasses.dataclass(frozen=True, eq=False)
class Nearest:
    """Nearest points of each query in two metrics; -1 if no point is within reach."""

    index: Int32[np.ndarray, "q"]
    """The nearest point."""
    distance: Float32[np.ndarray, "q"]
    """Distance to that point, metres; inf if there is none."""
    along: Int32[np.ndarray, "q"]
    """Nearest point in the metric that weighs distance along the query's axis less."""


def nearest(
    points: Float32[np.ndarray, "n 3"],
    queries: Float32[np.ndarray, "q 3"],
    axes: Float32[np.ndarray, "q 3"],
    stretch: float,
    reach: float,
) -> Nearest:
    """Nearest points within `reach` metres; `along` scales distance along a query's unit axis by `stretch` (0 ... 1).

    Points are hashed into cubes of side `reach`, so a query searches 27 of them.
    """
    low = points.min(0)
    shape = np.floor((points.max(0) - low) / reach).astype(np.int64) + 1
    cube = np.floor((points - low) / reach).astype(np.int64)
    number = (cube[:, 0] * shape[1] + cube[:, 1]) * shape[2] + cube[:, 2]
    order = np.argsort(number, kind="stable")
    start = np.searchsorted(number[order], np.arange(shape.prod() + 1))
    result = Nearest(
        np.full(len(queries), -1, np.int32),
        np.full(len(queries), np.inf, np.float32),
        np.full(len(queries), -1, np.int32),
    )
    gain = np.float32(1 - stretch * stretch)
    _nearest(
        points[order], order, start, shape, low, np.float32(reach), queries, axes, gain,
        result.index, result.distance, result.along,
    )  # fmt: skip
    return result


@numba.njit(cache=True, nogil=True, fastmath=True)
def _nearest(points, order, start, shape, low, reach, queries, axes, gain, found, distance, along):
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        cx, cy = int(np.floor((x - low[0]) / reach)), int(np.floor((y - low[1]) / reach))
        cz = int(np.floor((z - low[2]) / reach))
        ax, ay, az = axes[q, 0], axes[q, 1], axes[q, 2]
        best, best_squared = -1, reach * reach
        best_along, best_cost = -1, reach * reach
        z_from, z_to = max(cz - 1, 0), min(cz + 2, shape[2])
        if z_from >= z_to:
            continue
        for i in range(max(cx - 1, 0), min(cx + 2, shape[0])):
            for j in range(max(cy - 1, 0), min(cy + 2, shape[1])):
                row = (i * shape[1] + j) * shape[2]
                for n in range(start[row + z_from], start[row + z_to]):
                    dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
                    squared = dx * dx + dy * dy + dz * dz
                    if squared < best_squared:
                        best, best_squared = n, squared
                    if squared < reach * reach:
                        way = dx * ax + dy * ay + dz * az
                        cost = squared - gain * way * way
                        if cost < best_cost:
                            best_along, best_cost = n, cost
        if best >= 0:
            found[q] = order[best]
            distance[q] = np.sqrt(best_squared)
            along[q] = order[best_along]


def carve(
    queries: Float32[np.ndarray, "q 3"], views: list[OrthographicView], drawn: list[Fragments]
) -> Float32[np.ndarray, "q"]:
    """The least depth of each query behind the surface that a view sees, metres; negative if any view sees past it."""
    behind = np.full(len(queries), np.inf, np.float32)
    for view, fragments in zip(views, drawn, strict=True):
        _carve(queries, view.world_to_view.astype(np.float32), np.float32(view.pixel_size), fragments.depth, behind)
    return behind


@numba.njit(cache=True, nogil=True)
def _carve(queries, world_to_view, pixel_size, depth, behind):
    height, width = depth.shape
    m = world_to_view
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        column = int(np.floor((m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / pixel_size))
        row = int(np.floor((m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / pixel_size))
        past = np.float32(-np.inf)
        if 0 <= column < width and 0 <= row < height:
            past = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] - depth[row, column]
        behind[q] = min(behind[q], past)
