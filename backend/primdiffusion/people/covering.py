"""Prevent skin from poking through clothes: hide covered skin, and sink the strip of it that remains at hems.

Body and clothes are skinned separately, so bending can push skin through cloth close to it. Two remedies, computed once
for each garment on the average body and valid for all bodies and poses:

- skin under cloth and far from every hem (along the body's surface) is removed;
- a strip of skin is kept under the hem, because sleeves can be looked into, and sunk below the cloth.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from trimesh import Trimesh

from primdiffusion.geometry.textured_mesh import vertex_normals
from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import BaseMesh
from primdiffusion.people.fitting import fit_item

REACH_OUT, REACH_IN = 0.045, 0.015
"""Largest distance of covering cloth outside the skin, and inside it, metres."""
STRIP = 0.012
"""Width of the strip of skin kept under a hem, metres."""
GAP_SHARE = 1.0
"""Additional width of the strip per metre of gap between skin and cloth: wide openings reveal more."""
SINK, CLEARANCE = 0.006, 0.003
"""How far the strip is sunk at its inner edge, and below cloth that lies inside the skin, metres."""
GRID = 1e-4
"""Distances are rounded to this many metres before comparisons, so that results do not depend on the machine."""


@dataclasses.dataclass(frozen=True, eq=False)
class Cover:
    """Effect of one garment on the skin of the base mesh."""

    hidden: Bool[np.ndarray, " B"]
    """Vertices that are never visible."""
    sink: Float[np.ndarray, " B"]
    """Inward displacement of each vertex, metres."""


@functools.lru_cache(maxsize=32)
def cover(assets: Assets, base: BaseMesh, path: str) -> Cover:
    """Find what a garment covers by casting rays along the skin's normals of the average body. Takes one second."""
    vertices = base.template
    _, mesh = assets.proxy(path)
    skin = np.unique(base.faces)
    normal = vertex_normals(vertices, base.faces)[skin]
    corners = fit_item(assets, base, path, vertices)[mesh.faces]
    gap = np.full(len(vertices), np.inf)
    gap[skin] = _gaps(vertices[skin], normal, corners, REACH_OUT, REACH_IN)
    gap = np.round(gap / GRID) * GRID
    bare = np.zeros(len(vertices), bool)
    bare[skin] = np.isinf(gap[skin])
    if not bare.any():
        return Cover(~bare, np.zeros(len(vertices)))
    depth = np.round(_distance(base, vertices, bare) / GRID) * GRID
    strip = STRIP + GAP_SHARE * np.where(np.isfinite(gap), np.maximum(gap, 0), 0)
    covered = np.isfinite(gap)
    sink = np.where(covered, np.clip(depth / STRIP, 0, 1) * np.maximum(SINK, CLEARANCE - gap), 0)
    return Cover(covered & (depth > strip), sink)


def sunk(vertices: Float[np.ndarray, "B 3"], base: BaseMesh, covers: tuple[Cover, ...]) -> Float[np.ndarray, "B 3"]:
    """Sink the covered vertices of the body below its garments."""
    depth = np.max([garment.sink for garment in covers], axis=0)
    return vertices - depth[:, None] * vertex_normals(vertices, base.faces)


def _distance(base: BaseMesh, vertices: Float[np.ndarray, "B 3"], bare: Bool[np.ndarray, " B"]) -> np.ndarray:
    """Distance along edges from each vertex to the nearest bare one, metres; inf if unreachable."""
    mesh = Trimesh(vertices, base.faces, process=False)
    graph = coo_matrix((mesh.edges_unique_length, mesh.edges_unique.T), shape=(len(vertices), len(vertices))).tocsr()
    return dijkstra(graph, directed=False, indices=np.flatnonzero(bare), min_only=True)


@njit(cache=True)
def _gaps(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray, out: float, inward: float) -> np.ndarray:
    """Signed distance from each point along its direction to the nearest triangle; inf if out of range."""
    gap = np.full(len(origin), np.inf)
    middle = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3
    for t in range(len(corners)):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        radius = 0.0
        for k in range(3):
            radius = max(radius, np.sum((corners[t, k] - middle[t]) ** 2))
        limit = (np.sqrt(radius) + out) ** 2
        ab, ac = b - a, c - a
        for i in range(len(origin)):
            x, y, z = origin[i, 0] - middle[t, 0], origin[i, 1] - middle[t, 1], origin[i, 2] - middle[t, 2]
            if x * x + y * y + z * z > limit:
                continue
            d = direction[i]
            p0, p1, p2 = d[1] * ac[2] - d[2] * ac[1], d[2] * ac[0] - d[0] * ac[2], d[0] * ac[1] - d[1] * ac[0]
            det = ab[0] * p0 + ab[1] * p1 + ab[2] * p2
            if abs(det) < 1e-14:
                continue
            s0, s1, s2 = origin[i, 0] - a[0], origin[i, 1] - a[1], origin[i, 2] - a[2]
            u = (s0 * p0 + s1 * p1 + s2 * p2) / det
            if u < 0 or u > 1:
                continue
            q0, q1, q2 = s1 * ab[2] - s2 * ab[1], s2 * ab[0] - s0 * ab[2], s0 * ab[1] - s1 * ab[0]
            v = (d[0] * q0 + d[1] * q1 + d[2] * q2) / det
            if v < 0 or u + v > 1:
                continue
            distance = (ac[0] * q0 + ac[1] * q1 + ac[2] * q2) / det
            if -inward < distance < out and abs(distance) < abs(gap[i]):
                gap[i] = distance
    return gap
