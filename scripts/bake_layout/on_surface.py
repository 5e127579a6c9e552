"""Points on the body as faces and barycentric coordinates."""

from __future__ import annotations

import igl
import numpy as np
from numpy import ndarray as Array


def barycentric_on(vertices: Array, faces: Array, face: Array, points: Array) -> Array:
    """[n, 3] coordinates of points on the faces `face`, clipped to the face because cut pieces have rounding errors."""
    a, b, c = (vertices[faces[face, k]] for k in range(3))
    e1, e2, d = b - a, c - a, points - a
    g11, g12, g22 = (e1 * e1).sum(1), (e1 * e2).sum(1), (e2 * e2).sum(1)
    r1, r2 = (d * e1).sum(1), (d * e2).sum(1)
    determinant = g11 * g22 - g12**2 + 1e-30
    wb, wc = (g22 * r1 - g12 * r2) / determinant, (g11 * r2 - g12 * r1) / determinant
    weights = np.clip(np.stack([1 - wb - wc, wb, wc], -1), 0, 1)
    return weights / weights.sum(1, keepdims=True)


def closest_on_faces(vertices: Array, faces: Array, subset: Array, points: Array) -> tuple[Array, Array]:
    """Face (one of `subset`) and barycentric coordinates of the closest surface points."""
    _, index, closest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), vertices, np.ascontiguousarray(faces[subset])
    )[:3]
    face = subset[index]
    return face, barycentric_on(vertices, faces, face, closest)
