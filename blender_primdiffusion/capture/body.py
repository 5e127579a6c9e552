"""A body of SMPL's form in numpy, for posing and fitting in Blender; the backend's `primdiffusion.body` is its twin."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..formats.arrays import ArrayFileError, read_arrays
from ..formats.joints import PARENTS
from ..motion.skeleton import chain, joint_positions
from ..places import backend_module_path

BETAS = 10
"""Shape components in use."""
_KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "f", "kintree_table")


class BodyError(ValueError):
    """A body model that cannot be read; one sentence."""


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

        Raises BodyError where there are more betas than the body has components and the further ones are not zero.
        """
        betas = np.asarray(betas, np.float64).ravel()
        known = self.shape_basis.shape[-1]
        if np.any(betas[known:] != 0):
            raise BodyError(f"{len(betas)} betas were given, the body {self.name!r} has {known}: drop the last ones")
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


def default_body_path() -> Path:
    """The body that ships with the backend. Raises BodyError where the backend is not there."""
    backend = backend_module_path()
    path = backend / "primdiffusion" / "body" / "data" / "body.npz" if backend is not None else None
    if path is None or not path.is_file():
        raise BodyError("the default body is not part of this installation: install the extension again")
    return path


def read_body(path: Path | None = None) -> Body:
    """The default body, or a user's own SMPL as an .npz of plain arrays.

    Raises BodyError where the file is not there, holds pickled arrays, or is not of SMPL's form.
    """
    source = default_body_path() if path is None else Path(path)
    if not source.is_file():
        raise BodyError(f"there is no body model {source}: check the path")
    try:
        arrays = read_arrays(source, optional=_KEYS)
    except ArrayFileError as e:
        raise BodyError(f"{e}; a body model is an .npz of plain arrays in SMPL's form") from e
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
        raise BodyError(f"{source} holds no {missing[0]!r}: use an .npz of SMPL's form with plain arrays")
    count = len(arrays["v_template"])
    shapes = {
        "v_template": (count, 3), "shapedirs": (count, 3, None), "posedirs": (count, 3, 207),
        "J_regressor": (24, count), "weights": (count, 24), "f": (None, 3), "kintree_table": (2, 24),
    }  # fmt: skip
    for key, shape in shapes.items():
        array = arrays[key]
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise BodyError(f"{source}: {key!r} has shape {array.shape} of {array.dtype}, not SMPL's finite numbers")
    if tuple(arrays["kintree_table"][0][1:].tolist()) != PARENTS[1:]:
        raise BodyError(f"{source}: its joints are not SMPL's 24; SMPL-H and SMPL-X bodies do not serve here")
    if arrays["f"].max(initial=0) >= count:
        raise BodyError(f"{source}: its faces name vertices that are not there")
