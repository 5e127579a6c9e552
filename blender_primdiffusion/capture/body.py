"""A body of SMPL's form in numpy, posed, and fitted to joints or to a surface.

The backend's `primdiffusion.body` is its twin.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files.arrays import MOST_BODY_VALUES, all_finite, read_arrays
from ..files.regular_files import FileError
from ..formats.body_layout import body_data
from ..formats.joints import JOINT_NAMES, PARENTS
from ..formats.poses.skeleton import chain, joint_positions

BETAS = 10
"""Shape components in use."""
_KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "f", "kintree_table")
_BODY_MODEL = "use an .npz of SMPL's form with plain arrays"


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A body before it has a shape; metres, y up, facing +z."""

    name: str
    """"default", or the name of the file it is from."""
    template: NDArray[np.float64]
    """The mean body at rest [V, 3]."""
    shape_basis: NDArray[np.float64]
    """What a unit of each shape coefficient adds [V, 3, B], B <= 10."""
    pose_basis: NDArray[np.float64]
    """What each entry of (R - I) of the joints below the pelvis adds [V, 3, 207]; [V, 3, 0] where that is nothing."""
    joint_regressor: NDArray[np.float64]
    """Joints as weighted sums of the shaped vertices [24, V]."""
    skin_weights: NDArray[np.float64]
    """Rows sum to 1 [V, 24]."""
    faces: NDArray[np.int64]
    """Counter-clockwise seen from outside [F, 3]."""
    parents: tuple[int, ...] = PARENTS

    def rest(self, betas: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """A person's vertices [V, 3] and joints [24, 3] at rest (SMPL eqs. 8 and 10). Missing betas count as zero.

        Raises ValueError where there are more betas than the body has components and the further ones are not zero.
        """
        betas = np.asarray(betas, np.float64).ravel()
        known = self.shape_basis.shape[-1]
        if np.any(betas[known:] != 0):
            raise ValueError(f"{len(betas)} betas were given, the body {self.name!r} has {known}: drop the last ones")
        vertices = self.template + self.shape_basis[..., : len(betas)] @ betas[:known]
        return vertices, self.joint_regressor @ vertices

    def pose(
        self, betas: NDArray, rotations: NDArray, translation: NDArray
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Vertices [V, 3], joints [24, 3] and skinning transforms [24, 4, 4] (world <- rest) of a person in a pose.

        Joint rotations [24, 3, 3] relative to the parents, translation [3] in metres (SMPL eqs. 2-4, 7 and 9).
        """
        vertices, rest_joints = self.rest(betas)
        if self.pose_basis.size:
            vertices = vertices + self.pose_basis @ (np.asarray(rotations)[1:] - np.eye(3)).ravel()
        joints, skinning = skinning_transforms(rotations, translation, rest_joints)
        return skin(vertices, self.skin_weights, skinning), joints, skinning


def skinning_transforms(
    rotations: NDArray, translation: NDArray, rest_joints: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Joints [24, 3] and what each does to points of the rest pose [24, 4, 4], of a skeleton at rest [24, 3]."""
    joints = joint_positions(rotations, translation, rest_joints)
    transforms = np.tile(np.eye(4), (len(joints), 1, 1))
    transforms[:, :3, :3] = chain(rotations)
    transforms[:, :3, 3] = joints - (transforms[:, :3, :3] @ rest_joints[..., None])[..., 0]
    return joints, transforms


def blend(weights: NDArray, transforms: NDArray) -> NDArray[np.float64]:
    """Weighted means [V, 3, 4] of transforms [J, 4, 4] by weights [V, J]."""
    blended: NDArray[np.float64] = weights @ transforms[:, :3].reshape(len(transforms), 12)
    return blended.reshape(-1, 3, 4)


def skin(points: NDArray, weights: NDArray, transforms: NDArray) -> NDArray[np.float64]:
    """Points [V, 3] moved by the weighted mean of the joints' transforms (linear blend skinning)."""
    blended = blend(weights, transforms)
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]


def read_body(path: Path | None = None) -> Body:
    """The default body, or a user's own SMPL as an .npz of plain arrays.

    Raises FileNotFoundError without a default body, and FileError where the file is not there, holds pickled arrays, or
    is not of SMPL's form.
    """
    source = body_data("body.npz") if path is None else Path(path)
    if not source.is_file():
        raise FileError(source, "does not exist", "check the path of the body model")
    arrays = read_arrays(source, optional=_KEYS, most_values=MOST_BODY_VALUES)
    _check(source, arrays)
    pose_basis = np.asarray(arrays["posedirs"], np.float64)
    return Body(
        name="default" if path is None else source.stem,
        template=np.asarray(arrays["v_template"], np.float64),
        shape_basis=np.asarray(arrays["shapedirs"][..., :BETAS], np.float64),
        pose_basis=pose_basis if pose_basis.any() else pose_basis[..., :0],
        joint_regressor=np.asarray(arrays["J_regressor"], np.float64),
        skin_weights=np.asarray(arrays["weights"], np.float64),
        faces=np.asarray(arrays["f"], np.int64),
    )


def _check(source: Path, arrays: dict[str, NDArray]) -> None:
    missing = [key for key in _KEYS if key not in arrays]
    if missing:
        raise FileError(source, f"holds no {missing[0]!r}", _BODY_MODEL)
    count = len(np.atleast_1d(arrays["v_template"]))
    shapes = {
        "v_template": (count, 3), "shapedirs": (count, 3, None), "posedirs": (count, 3, 207),
        "J_regressor": (24, count), "weights": (count, 24), "f": (None, 3), "kintree_table": (2, 24),
    }  # fmt: skip
    for key, shape in shapes.items():
        array = arrays[key]
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits or array.dtype.kind not in "iuf" or not (key == "kintree_table" or all_finite(array)):
            found = f"holds {key!r} of shape {array.shape} and type {array.dtype}, not SMPL's finite numbers"
            raise FileError(source, found, _BODY_MODEL)
    if tuple(arrays["kintree_table"][0][1:].tolist()) != PARENTS[1:]:
        raise FileError(source, "has other joints than SMPL's 24", "use a body of SMPL, not of SMPL-H or SMPL-X")
    if arrays["f"].max(initial=0) >= count or arrays["f"].min(initial=0) < 0:
        raise FileError(source, "has faces with vertices that are not there", _BODY_MODEL)


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
_BETTER = 0.75
"""Another size counts only if its fit costs less than this fraction of the fit at the scan's own."""


@dataclasses.dataclass(frozen=True)
class ShapeFit:
    """A body's shape, and how a skeleton is moved to meet it."""

    betas: NDArray[np.float64]
    """[B]."""
    scale: float
    """Factor on the scan: 1 unless only another size fits."""
    shift: NDArray[np.float64]
    """Shift of the scan after scaling [3], metres."""
    residual: float
    """Weighted root mean square distance of the joints, metres."""


def fit_joints(body: Body, joints: Mapping[str, NDArray]) -> ShapeFit:
    """The shape whose joints at rest are nearest to `joints` (SMPL's name -> place at the T rest, metres, y up).

    min over betas, shift: sum_j w_j |scale * x_j + shift - J_j(betas)|^2 + ridge |betas|^2, whose J is linear in betas.
    Betas beyond `_LARGEST_BETA` are held there, and the others solved again. The scale is 1: another one between
    `_SCALES` is tried only where the fit at 1 is poor, and taken where the distances in the scan's own metres,
    residual / scale, are much smaller. Distances after scaling fall with the scale whatever the shape.
    """
    names = [name for name in JOINT_NAMES if name in joints]
    places = np.array([joints[name] for name in names])
    rows = [JOINT_NAMES.index(name) for name in names]
    weight = np.sqrt([_WEIGHTS.get(name.split("_")[-1], 1.0) for name in names])
    mean = (body.joint_regressor @ body.template)[rows]
    basis = np.einsum("jv,vcb->jcb", body.joint_regressor[rows], body.shape_basis)

    def cost(fit: ShapeFit) -> float:
        return fit.residual / fit.scale + _RIDGE_M * float(np.abs(fit.betas).max(initial=0))

    own = _solve(places, mean, basis, weight, 1.0)
    if own.residual <= _POOR_M:
        return own
    best = min((_solve(places, mean, basis, weight, s) for s in np.linspace(*_SCALES, 46)), key=cost)
    return best if cost(best) < _BETTER * cost(own) else own


def _solve(places: NDArray, mean: NDArray, basis: NDArray, weight: NDArray, scale: float) -> ShapeFit:
    count, betas = len(places), basis.shape[-1]
    shifts = np.broadcast_to(-np.eye(3), (count, 3, 3))
    unknowns = (np.concatenate([basis, shifts], -1) * weight[:, None, None]).reshape(3 * count, betas + 3)
    target = ((scale * places - mean) * weight[:, None]).ravel()
    rows = np.concatenate([unknowns, np.eye(betas, betas + 3) * _RIDGE_M])
    values, free = np.zeros(betas + 3), np.ones(betas + 3, np.bool_)
    while True:
        wanted = np.concatenate([target, np.zeros(betas)]) - rows[:, ~free] @ values[~free]
        values[free] = np.linalg.lstsq(rows[:, free], wanted, rcond=None)[0]
        beyond = free & (np.abs(values) > _LARGEST_BETA)
        beyond[betas:] = False
        if not beyond.any():
            break
        values[beyond], free = np.sign(values[beyond]) * _LARGEST_BETA, free & ~beyond
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
