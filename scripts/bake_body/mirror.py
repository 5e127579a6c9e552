"""Exact left-right symmetry of the mesh, its triangles and every person."""

from __future__ import annotations

import numpy as np
from population import BaseMeshSource
from skeleton import MIRRORED_JOINT

FLIP = np.array([-1.0, 1.0, 1.0])


def mirrored_vertex(template: np.ndarray) -> np.ndarray:
    """For each vertex, the one at its mirror image. A lookup suffices, because the base mesh is exactly symmetric."""
    number = {tuple(position): i for i, position in enumerate(np.round(template, 7) + 0.0)}
    twin = np.array([number[tuple(position)] for position in np.round(template * FLIP, 7) + 0.0])
    if not np.array_equal(twin[twin], np.arange(len(twin))):
        raise ValueError("The template is not mirror symmetric: two vertices coincide; bake from a symmetric mesh.")
    return twin


def symmetrise(points: np.ndarray, twin: np.ndarray) -> np.ndarray:
    """The mean of [..., V, 3] points and their mirror image."""
    return (points + points[..., twin, :] * FLIP.astype(points.dtype)) / 2


def symmetrise_weights(weights: np.ndarray, twin: np.ndarray) -> np.ndarray:
    """The mean of [V, 24] weights and those of the mirrored person."""
    return (weights + weights[twin][:, MIRRORED_JOINT]) / 2


def triangulate(source: BaseMeshSource, twin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and texture coordinates, two triangles per quad; diagonals on the right mirror those on the left.

    Cavities are left out. Of Q quads, quad q gives triangles q and q + Q. On the person's left (x > 0) the diagonal
    joins corners 0 and 2.
    """
    quads, uv_quads = source.faces[~source.cavity], source.uv_faces[~source.cavity]
    quad_of_vertices = {frozenset(quad): q for q, quad in enumerate(quads)}
    right = source.template[quads, 0].mean(1) < 0
    corners = np.tile([0, 1, 2, 3], (len(quads), 1))
    for q in np.flatnonzero(right):
        left_quad = quads[quad_of_vertices[frozenset(twin[quads[q]])]]
        if twin[left_quad[0]] not in quads[q][[0, 2]]:
            corners[q] = [1, 2, 3, 0]
    rows = np.arange(len(quads))[:, None]
    halves = [corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]
    return (
        np.concatenate([quads[rows, half] for half in halves]),
        np.concatenate([uv_quads[rows, half] for half in halves]),
    )
