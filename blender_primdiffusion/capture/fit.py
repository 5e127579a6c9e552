"""Fit the shape of a body to a scan: to the joints of a skeleton, or to a surface."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from .body import Body

_RIDGE_M = 0.008
"""A beta of 1 costs as much as a joint that is this far off, metres: rigs are no more exact than that."""
_WEIGHTS = {"hip": 0.5, "collar": 0.1, "hand": 0.2, "foot": 0.3, "pelvis": 0.2, "spine1": 0.05, "spine2": 0.05,
            "spine3": 0.05, "neck": 0.3, "head": 0.3}  # fmt: skip
"""Weights of joints, 1 for the others: rigs agree on knees and elbows, less on spines and toes."""
_SURFACE_RIDGE_M = 0.002
"""A beta of 1 costs as much as a surface that is this far off everywhere, metres."""
_LARGEST_BETA = 4.0
_SCALES = (0.8, 1.25)
_POOR_M = 0.03


@dataclasses.dataclass(frozen=True)
class ShapeFit:
    """A body's shape, and how a skeleton is moved to meet it."""

    betas: NDArray[np.float64]
    """[B]."""
    scale: float
    """Of the scan: 1 unless only another size fits."""
    shift: NDArray[np.float64]
    """Of the scan after scaling [3], metres."""
    residual: float
    """Weighted root mean square distance of the joints, metres."""


def fit_joints(body: Body, joints: Mapping[str, NDArray]) -> ShapeFit:
    """The shape whose joints at rest are nearest to `joints` (SMPL's name -> place at the T rest, metres, y up).

    min over betas, shift: sum_j w_j |scale * x_j + shift - J_j(betas)|^2 + ridge |betas|^2, whose J is linear in betas.
    The scale is 1, and free between `_SCALES` only where a fit at 1 is poor or its betas are too large.
    """
    names = [name for name in JOINT_NAMES if name in joints]
    places = np.array([joints[name] for name in names])
    rows = [JOINT_NAMES.index(name) for name in names]
    weight = np.sqrt([_WEIGHTS.get(name.split("_")[-1], 1.0) for name in names])
    mean = (body.joint_regressor @ body.template)[rows]
    basis = np.einsum("jv,vcb->jcb", body.joint_regressor[rows], body.shape_basis)
    best = _solve(places, mean, basis, weight, 1.0)
    if best.residual > _POOR_M or np.abs(best.betas).max(initial=0) > _LARGEST_BETA:
        tried = [_solve(places, mean, basis, weight, s) for s in np.linspace(*_SCALES, 46)]
        best = min((*tried, best), key=lambda fit: fit.residual + _RIDGE_M * float(np.abs(fit.betas).max(initial=0)))
    return best


def _solve(places: NDArray, mean: NDArray, basis: NDArray, weight: NDArray, scale: float) -> ShapeFit:
    count, betas = len(places), basis.shape[-1]
    shifts = np.broadcast_to(-np.eye(3), (count, 3, 3))
    unknowns = (np.concatenate([basis, shifts], -1) * weight[:, None, None]).reshape(3 * count, betas + 3)
    target = ((scale * places - mean) * weight[:, None]).ravel()
    ridge = np.concatenate([np.eye(betas) * _RIDGE_M, np.zeros((betas, 3))], -1)
    solution = np.linalg.lstsq(np.concatenate([unknowns, ridge]), np.concatenate([target, np.zeros(betas)]), rcond=None)
    values = solution[0]
    off = (unknowns @ values - target).reshape(count, 3)
    residual = float(np.sqrt((off**2).sum() / (weight**2).sum()))
    return ShapeFit(values[:betas], scale, values[betas:], residual)


def fit_surface(
    body: Body,
    betas: NDArray,
    rotations: NDArray,
    translation: NDArray,
    nearest: Callable[[NDArray, NDArray], tuple[NDArray, NDArray]],
    rounds: int = 8,
) -> ShapeFit:
    """The shape and the shift of a posed body whose surface is nearest to a scan's.

    `nearest` returns, for points [n, 3] with normals [n, 3], the nearest points of the scan [n, 3] and their trust
    [n], 0 ... 1. A posed vertex is linear in betas, so each round is a least-squares problem. The residual is the root
    mean square of the distances, weighted by trust, metres.
    """
    betas = np.array(betas, np.float64)[: body.shape_basis.shape[-1]]
    betas = np.concatenate([betas, np.zeros(body.shape_basis.shape[-1] - len(betas))])
    shift, residual = np.zeros(3), np.inf
    chosen = np.arange(0, len(body.template), max(1, len(body.template) // 1500))
    for number in range(rounds + 1):
        vertices, _, skinning = body.pose(betas, rotations, translation + shift)
        target, trust = nearest(vertices[chosen], vertex_normals(vertices, body.faces)[chosen])
        off = target - vertices[chosen]
        residual = float(np.sqrt((trust * (off**2).sum(-1)).sum() / max(trust.sum(), 1e-9)))
        if number == rounds:
            break
        linear = (body.skin_weights[chosen] @ skinning[:, :3, :3].reshape(24, 9)).reshape(-1, 3, 3)
        step = _surface_step(linear @ body.shape_basis[chosen], off, trust, betas)
        betas, shift = np.clip(betas + step[:-3], -_LARGEST_BETA, _LARGEST_BETA), shift + step[-3:]
    return ShapeFit(betas, 1.0, shift, residual)


def _surface_step(basis: NDArray, off: NDArray, trust: NDArray, betas: NDArray) -> NDArray[np.float64]:
    """The change of betas and shift that best takes points by `off` [n, 3]; `basis` [n, 3, B] is a beta's effect.

    Joints, which move with the betas too, are updated in the next round.
    """
    count = basis.shape[-1]
    unknowns = np.concatenate([basis, np.broadcast_to(np.eye(3), (len(basis), 3, 3))], -1)
    weight = np.sqrt(trust)[:, None, None]
    ridge = _SURFACE_RIDGE_M * np.sqrt(trust.sum())
    left = np.concatenate([(unknowns * weight).reshape(-1, count + 3), np.eye(count, count + 3) * ridge])
    right = np.concatenate([(off[..., None] * weight).ravel(), -betas * ridge])
    return np.linalg.lstsq(left, right, rcond=None)[0]


def vertex_normals(vertices: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """Unit normals [V, 3] of vertices, weighted by the areas of faces; zero without faces."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = np.stack(
        [np.bincount(faces.ravel(), np.repeat(normals[:, axis], 3), len(vertices)) for axis in range(3)], -1
    )
    return summed / np.maximum(np.linalg.norm(summed, axis=-1, keepdims=True), 1e-30)
