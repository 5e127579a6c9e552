"""Cuts patches open to discs: paths along edges, cuts along paths, the loop around a disc."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from half_body import boundary_edges
from numpy import ndarray as Array
from scipy.sparse.csgraph import connected_components, dijkstra


def cheapest_path(
    points: Array,
    faces: Array,
    start: int,
    end: int,
    cost: Callable[[Array], Array] = lambda middle: np.ones(len(middle)),
    avoid: Sequence[int] = (),
) -> list[int]:
    """Vertices of the path from start to end along edges with the least sum of length x cost(edge middle).

    Vertices in `avoid` can only be the ends of the path.
    """
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    closed = np.setdiff1d(np.asarray(avoid, dtype=int), [start, end])
    edges = edges[~np.isin(edges, closed).any(1)]
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    graph = sp.coo_matrix((length * cost(points[edges].mean(1)), edges.T), shape=(len(points),) * 2)
    before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)[1]
    path = [end]
    while path[-1] != start:
        if before[path[-1]] < 0:
            raise ValueError(f"no path from vertex {start} to {end} in this patch; its cuts must have changed")
        path.append(int(before[path[-1]]))
    return path[::-1]


def cut_along(faces: Array, path: Sequence[int]) -> tuple[Array, Array]:
    """The faces renumbered so that the two sides of the path are separate, and the old index of each new vertex."""
    count = len(faces)
    blocked = {tuple(sorted(edge)) for edge in pairwise(path)}
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(count), 3)
    order = np.lexsort(edges.T)
    edges, owner = edges[order], owner[order]
    joined = np.flatnonzero((edges[1:] == edges[:-1]).all(1))
    joined = joined[[tuple(edge) not in blocked for edge in edges[joined].tolist()]]
    a, b, shared = owner[joined], owner[joined + 1], edges[joined]
    rows, columns = [], []
    for end in range(2):
        rows.append(a * 3 + (faces[a] == shared[:, [end]]).argmax(1))
        columns.append(b * 3 + (faces[b] == shared[:, [end]]).argmax(1))
    rows, columns = np.concatenate(rows), np.concatenate(columns)
    graph = sp.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(3 * count,) * 2)
    number, label = connected_components(graph, directed=False)
    origin = np.zeros(number, dtype=int)
    origin[label] = faces.ravel()
    return label.reshape(-1, 3), origin


def outline(faces: Array) -> list[int]:
    """The boundary of a disc as a loop of vertices, counter-clockwise seen from outside."""
    edges = boundary_edges(faces)
    following = dict(edges.tolist())
    loop = [int(edges[0, 0])]
    while following[loop[-1]] != loop[0]:
        loop.append(following[loop[-1]])
    if len(loop) != len(edges):
        raise ValueError(f"a patch has a boundary of {len(edges)} edges in more than one loop, so it is not a disc")
    return loop


def runs(loop: Sequence[int], marked: Array) -> list[list[int]]:
    """Maximal runs of the loop, in its direction, along edges with both ends marked."""
    count = len(loop)
    both = [marked[loop[i]] and marked[loop[(i + 1) % count]] for i in range(count)]
    found: list[list[int]] = []
    for i in range(count):
        if both[i] and not both[i - 1]:
            stretch = [loop[i]]
            while both[i % count]:
                i += 1
                stretch.append(loop[i % count])
            found.append(stretch)
    return found
