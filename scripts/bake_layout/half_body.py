"""The person's left half as a closed sheet, from which the charts are cut."""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.sparse as sp
from numpy import ndarray as Array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

FILLED = -1
"""The parent of a face that closes a hole (eye, mouth) and is not part of the body."""


@dataclasses.dataclass(frozen=True)
class Sheet:
    """A triangle mesh whose faces know which face of the body they come from."""

    points: Array
    """[n, 3] float64, metres."""
    faces: Array
    """[m, 3] int."""
    parent: Array
    """[m] int: face of the body, or FILLED."""
    midline: Array
    """[n] bool: points in the plane of symmetry, x = 0."""


def mirror_vertices(vertices: Array) -> Array:
    """[V] int: the vertex opposite to each; ValueError unless the body is symmetric in x to 1 micrometre."""
    distance, opposite = cKDTree(vertices).query(vertices * (-1, 1, 1))
    if distance.max() > 1e-6:
        raise ValueError(f"the body differs by {distance.max():.1e} m from its mirror image: bake with the mirror step")
    return opposite


def left_half(vertices: Array, faces: Array) -> Sheet:
    """The faces at x > 0, with fans over the eye socket and the open half of the mouth."""
    midline = mirror_vertices(vertices) == np.arange(len(vertices))
    parent = np.flatnonzero(vertices[faces][:, :, 0].mean(1) > 0)
    left_faces = faces[parent]
    edges = boundary_edges(left_faces)
    edges = edges[~midline[edges].all(1)]
    graph = sp.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    component = connected_components(graph, directed=False)[1][edges[:, 0]]
    points, on_midline, fans = [vertices], [midline], [left_faces]
    for hole in np.unique(component):
        rim = edges[component == hole]
        used = np.unique(rim)
        centre = vertices[used].mean(0)
        half_hole = midline[used].any()
        centre[0] = 0 if half_hole else centre[0]
        apex = len(vertices) + len(points) - 1
        points.append(centre[None])
        on_midline.append(np.array([half_hole]))
        fans.append(np.column_stack([rim[:, ::-1], np.full(len(rim), apex)]))
    filled = sum(len(fan) for fan in fans[1:])
    parent = np.concatenate([parent, np.full(filled, FILLED)])
    return Sheet(np.concatenate(points), np.concatenate(fans), parent, np.concatenate(on_midline))


def boundary_edges(faces: Array) -> Array:
    """[e, 2] directed edges (in the direction of their face) that belong to one face only."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, index, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    return edges[count[index.reshape(-1)] == 1]


def smoothed(sheet: Sheet, radius: float, steps: int = 3) -> Array:
    """The points after implicit mean-curvature flow over about `radius` metres; midline points stay at x = 0.

    Charts are laid out on this copy; otherwise every nostril and toe would get cells of its own.
    """
    points = sheet.points.copy()
    used = np.unique(sheet.faces)
    inner = used[~sheet.midline[used]]
    for _ in range(steps):
        laplacian, mass = _cotangent_laplacian(points, sheet.faces)
        mass = np.maximum(mass, 1e-9)
        system = (sp.diags(mass) + radius**2 / steps * laplacian).tocsr()
        weighted = mass[:, None] * points
        points[used, 1:] = splu(system[used][:, used].tocsc()).solve(weighted[used])[:, 1:]
        points[inner, 0] = splu(system[inner][:, inner].tocsc()).solve(weighted[inner, 0])
    return points


def _cotangent_laplacian(points: Array, faces: Array) -> tuple[sp.csr_matrix, Array]:
    rows, columns, weights = [], [], []
    for corner in range(3):
        a, b, c = (faces[:, (corner + k) % 3] for k in range(3))
        u, w = points[a] - points[c], points[b] - points[c]
        # Clipped: needle triangles have cotangents that would make the flow run backwards.
        cotangent = np.clip((u * w).sum(1) / (np.linalg.norm(np.cross(u, w), axis=1) + 1e-12), 0.05, 10) / 2
        rows += [a, b]
        columns += [b, a]
        weights += [cotangent, cotangent]
    shape = (len(points),) * 2
    weight = sp.coo_matrix((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape).tocsr()
    mass = np.zeros(len(points))
    area = np.linalg.norm(np.cross(*(points[faces[:, k]] - points[faces[:, 0]] for k in (1, 2))), axis=1) / 2
    for corner in range(3):
        np.add.at(mass, faces[:, corner], area / 3)
    return (sp.diags(np.asarray(weight.sum(1)).ravel()) - weight).tocsr(), mass
