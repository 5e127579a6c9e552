"""Skin under cloth: which of it never shows and is left out, and how far the rest of it steps back.

Body and clothes are skinned apart, so where they lie close, a bend of the body pushes skin through cloth. Two remedies,
found once for each garment on the average body and good for all bodies and poses:

- skin that lies under cloth and far from every hem (along the body's surface) is left out;
- the strip that remains under the hem, so that one can look a little way into a sleeve, is sunk below the cloth.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import BaseMesh
from primdiffusion.people.fitting import fit_item

REACH_OUT, REACH_IN = 0.045, 0.015
"""Cloth this far outside of the skin, or inside of it, covers it; metres."""
STRIP = 0.012
"""Width of the strip of skin that is kept under a hem, metres."""
GAP_SHARE = 1.0
"""The strip is wider by this share of the gap between skin and cloth, since one sees further into wide openings."""
SINK, CLEARANCE = 0.006, 0.003
"""How far the strip is sunk at its inner edge, and below cloth that lies inside of the skin; metres."""
GRID = 1e-4
"""Distances are rounded to this many metres before they are compared, so that every machine decides alike."""


@dataclasses.dataclass(frozen=True, eq=False)
class Cover:
    """What one garment does to the skin of the base mesh."""

    hidden: Bool[np.ndarray, " B"]
    """Vertices that never show."""
    sink: Float[np.ndarray, " B"]
    """How far each vertex goes inwards, metres."""


@functools.lru_cache(maxsize=32)
def cover(assets: Assets, base: BaseMesh, path: str) -> Cover:
    """What a garment covers, from rays along the skin's normals on the average body. Takes a second, once."""
    vertices = base.template
    _, mesh = assets.proxy(path)
    skin = np.unique(base.faces)
    normal = normals(vertices, base.faces)[skin]
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
    """The body's vertices with what several garments cover sunk below them."""
    depth = np.max([garment.sink for garment in covers], axis=0)
    return vertices - depth[:, None] * normals(vertices, base.faces)


def normals(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Outward unit normals of vertices, weighted by area; zero where no face is."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(total, faces[:, corner], across)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def _distance(base: BaseMesh, vertices: Float[np.ndarray, "B 3"], bare: Bool[np.ndarray, " B"]) -> np.ndarray:
    """The way along the skin's edges from each vertex to the nearest bare one, metres; inf where there is none."""
    edges = np.unique(np.sort(base.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = coo_matrix((length, (edges[:, 0], edges[:, 1])), shape=(len(vertices), len(vertices))).tocsr()
    return dijkstra(graph, directed=False, indices=np.flatnonzero(bare), min_only=True)


@njit(cache=True)
def _gaps(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray, out: float, inward: float) -> np.ndarray:
    """The signed distance from each point along its direction to the nearest triangle, inf beyond the reaches."""
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
