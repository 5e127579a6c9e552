"""Flattens a disc onto a rectangle with as little distortion as possible: Tutte's embedding, then SLIM.

SLIM is Rabinovich et al. 2017, "Scalable Locally Injective Mappings": the symmetric Dirichlet energy, minimised by
reweighted least squares with a step that keeps every triangle unflipped. Here the four corners are fixed and the other
boundary vertices slide along their side, which libigl's SLIM (soft point constraints) cannot express.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from numpy import ndarray as Array
from scipy.sparse.linalg import splu

ITERATIONS = 250
TOLERANCE = 2e-5
"""Relative decrease of the energy at which SLIM stops."""


@dataclasses.dataclass(frozen=True)
class Disc:
    """A patch opened to a disc."""

    points: Array
    """[n, 3] positions on the body."""
    smooth: Array
    """[n, 3] positions on the smoothed copy that is flattened."""
    faces: Array
    """[m, 3]."""
    parent: Array
    """[m] face of the body."""


@dataclasses.dataclass(frozen=True)
class Flat:
    """A disc on its rectangle."""

    disc: Disc
    uv: Array
    """[n, 2] in cells: 0 .. width, 0 .. height."""


def sides_of(loop: Sequence[int], corners: Sequence[int]) -> list[list[int]]:
    """The loop as four sides, bottom, right, top, left, each with both its corners (given in that order)."""
    first = loop.index(corners[0])
    turned = [*loop[first:], *loop[:first], loop[first]]
    stops = [0, *(turned.index(corner) for corner in corners[1:]), len(loop)]
    return [turned[a : b + 1] for a, b in pairwise(stops)]


def split_chords(disc: Disc, sides: Sequence[Sequence[int]]) -> Disc:
    """The disc with inner edges between two vertices of one side halved: a straight side would leave them no area."""
    outline = {tuple(sorted(edge)) for side in sides for edge in pairwise(side)}
    on_side = [set(side) for side in sides]
    edges = {tuple(sorted((face[k], face[(k + 1) % 3]))) for face in disc.faces.tolist() for k in range(3)}
    chords = [e for e in sorted(edges - outline) if any(e[0] in side and e[1] in side for side in on_side)]
    points, smooth, faces, parent = list(disc.points), list(disc.smooth), disc.faces.tolist(), list(disc.parent)
    for a, b in chords:
        middle = len(points)
        points.append((points[a] + points[b]) / 2)
        smooth.append((smooth[a] + smooth[b]) / 2)
        for index in [i for i, face in enumerate(faces) if a in face and b in face]:
            faces.append([middle if v == a else v for v in faces[index]])
            faces[index] = [middle if v == b else v for v in faces[index]]
            parent.append(parent[index])
    return Disc(np.array(points), np.array(smooth), np.array(faces), np.array(parent))


def flatten(
    disc: Disc,
    loop: Sequence[int],
    corners: Sequence[int],
    width: float,
    height: float,
    seams: Sequence[tuple[int, int]] = (),
    emphasis: float = 0.0,
) -> Flat:
    """The disc on a width x height rectangle.

    `corners` are the vertices for (0, 0), (width, 0), (width, height), (0, height); pairs in `seams` have equal height
    (the two copies of a cut, so that rows of cells go round a limb). `emphasis` raises the energy of a triangle to the
    power 1 + emphasis, which accepts a higher mean distortion for a lower maximum.
    """
    sides = sides_of(loop, corners)
    disc = split_chords(disc, sides)
    count = len(disc.points)
    uv = _tutte(disc, sides, width, height)
    unknowns = _sliding(count, sides, uv, seams)
    for a, b in seams:
        uv[b, 1] = uv[a, 1]
    area, to_x, to_y = _gradients(disc.smooth, disc.faces, width * height)

    def jacobian(uv: Array) -> Array:
        return np.stack([to_x @ uv, to_y @ uv], axis=-1)

    def energies(uv: Array) -> Array:
        jac = jacobian(uv)
        determinant = np.linalg.det(jac)
        if determinant.min() <= 0:
            return np.full(len(area), np.inf)
        norm = (jac**2).sum((1, 2))
        return (norm + norm / determinant**2) / 4

    def total(uv: Array) -> float:
        return float((area * energies(uv) ** (1 + emphasis)).sum() / area.sum())

    energy = total(uv)
    if not np.isfinite(energy):
        raise ValueError("the patch has flipped triangles at the start: move its corners or seam")
    for _ in range(ITERATIONS):
        weight = area * energies(uv) ** emphasis
        step = _proxy_step(jacobian(uv), uv, weight, to_x, to_y, unknowns)
        size, lower = 1.0, np.inf
        while size > 1e-6 and not lower < energy:
            lower = total(uv + size * step)
            size *= 0.7
        if not lower < energy:
            break
        uv = uv + size / 0.7 * step
        converged = energy - lower < TOLERANCE * lower
        energy = lower
        if converged:
            break
    return Flat(disc, uv)


def _tutte(disc: Disc, sides: Sequence[Sequence[int]], width: float, height: float) -> Array:
    """Boundary by arc length on the rectangle, every other vertex at the mean of its neighbours (never flips)."""
    corner = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
    uv = np.zeros((len(disc.points), 2))
    on_boundary = np.zeros(len(uv), dtype=bool)
    for k, side in enumerate(sides):
        steps = np.linalg.norm(np.diff(disc.smooth[side], axis=0), axis=1)
        share = np.concatenate([[0], np.cumsum(steps)])[:, None] / steps.sum()
        uv[side] = corner[k] * (1 - share) + corner[(k + 1) % 4] * share
        on_boundary[side] = True
    edges = disc.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    adjacency = sp.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(uv),) * 2).tocsr()
    adjacency = ((adjacency + adjacency.T) > 0).astype(float)
    laplacian = (sp.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency).tocsr()
    inner, outer = np.flatnonzero(~on_boundary), np.flatnonzero(on_boundary)
    uv[inner] = splu(laplacian[inner][:, inner].tocsc()).solve(-laplacian[inner][:, outer] @ uv[outer])
    return uv


def _sliding(count: int, sides: Sequence[Sequence[int]], uv: Array, seams: Sequence[tuple[int, int]]) -> sp.csr_matrix:
    """[2 n, free] matrix from the free coordinates to all (u of every vertex, then v)."""
    bottom, right, top, left = sides
    fixed = np.zeros(2 * count, dtype=bool)
    fixed[[*right, *left]] = True
    fixed[[count + v for v in (*bottom, *top)]] = True
    leader = np.arange(2 * count)
    for a, b in seams:
        if not fixed[count + a] and not fixed[count + b]:
            leader[count + b] = count + a
    free = np.flatnonzero(~fixed & (leader == np.arange(2 * count)))
    column = np.full(2 * count, -1)
    column[free] = np.arange(len(free))
    rows = np.flatnonzero(~fixed & (column[leader] >= 0))
    return sp.coo_matrix((np.ones(len(rows)), (rows, column[leader][rows])), shape=(2 * count, len(free))).tocsr()


def _gradients(points: Array, faces: Array, target_area: float) -> tuple[Array, sp.csr_matrix, sp.csr_matrix]:
    """Areas and derivative matrices of the faces in their own planes, scaled so that the whole has the target area."""
    e1, e2 = (points[faces[:, k]] - points[faces[:, 0]] for k in (1, 2))
    normal = np.cross(e1, e2)
    twice_area = np.linalg.norm(normal, axis=1)
    scale = np.sqrt(target_area / (twice_area.sum() / 2))
    x1 = np.linalg.norm(e1, axis=1)
    along = e1 / x1[:, None]
    across = np.cross(normal / (twice_area[:, None] + 1e-15), along)
    x1, x2, y2 = x1 * scale, (e2 * along).sum(1) * scale, (e2 * across).sum(1) * scale
    by_x = np.stack([-1 / x1, 1 / x1, 0 * x1], 1)
    by_y = np.stack([(x2 - x1) / (x1 * y2), -x2 / (x1 * y2), 1 / y2], 1)
    row = np.repeat(np.arange(len(faces)), 3)
    shape = (len(faces), len(points))
    to_x, to_y = (sp.coo_matrix((d.ravel(), (row, faces.ravel())), shape=shape).tocsr() for d in (by_x, by_y))
    area = twice_area / 2 * scale**2
    # A lower bound: otherwise the tiniest triangles would have almost no weight and become needles.
    return np.maximum(area, 1e-3 * area.mean()), to_x, to_y


def _proxy_step(
    jac: Array, uv: Array, weight: Array, to_x: sp.csr_matrix, to_y: sp.csr_matrix, unknowns: sp.csr_matrix
) -> Array:
    """The step to the minimum of SLIM's quadratic proxy: W (J - R) with W = U sqrt((s - s^-3) / (s - 1)) U^T."""
    u, s, vt = np.linalg.svd(jac)
    rotation = u @ vt
    s = np.maximum(s, 1e-6)
    near_one = np.abs(s - 1) < 1e-5
    stiffness = np.where(near_one, 4.0, (s - s**-3) / np.where(near_one, 1.0, s - 1))
    local = np.einsum("fij,fj,fkj->fik", u, np.sqrt(np.maximum(stiffness, 1e-6)), u) * np.sqrt(weight)[:, None, None]
    target = local @ rotation
    rows, right = [], []
    for i in range(2):
        for axis, derivative in enumerate((to_x, to_y)):
            rows.append(sp.hstack([sp.diags(local[:, i, j]) @ derivative for j in range(2)]))
            right.append(target[:, i, axis])
    matrix = sp.vstack(rows).tocsr()
    residual = np.concatenate(right) - matrix @ uv.T.ravel()
    reduced = (matrix @ unknowns).tocsr()
    normal = reduced.T @ reduced + 1e-10 * sp.identity(reduced.shape[1])
    return (unknowns @ splu(normal.tocsc()).solve(reduced.T @ residual)).reshape(2, -1).T
