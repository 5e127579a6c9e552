"""Poses of armatures with SMPL's joints: reading one, and the posture in the world that a picture is fitted in."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..formats.poses.rotation import from_axis_angle, to_axis_angle
from ..scene.armature import check_joints, model_origin, pose_from_joint_rotations, rest_rotations
from ..scene.convention import BLENDER_FROM_BACKEND, points_to_backend, points_to_blender

_UNSCALED = 1e-3


def rest_joints(armature: bpy.types.Object) -> NDArray[np.float64]:
    """SMPL's joints at rest [24, 3] in the body model's space, y up, in the armature's units. Raises ValueError as
    `check_joints`."""
    check_joints(armature)
    heads = np.array([armature.data.bones[name].head_local for name in JOINT_NAMES], np.float64)
    return points_to_backend(heads - model_origin(armature.data))


def check_posable(armature: bpy.types.Object) -> None:
    """Raises ValueError, in a sentence, where the armature cannot be posed or keyed now."""
    if armature.library is not None:
        raise ValueError(
            f"{armature.name!r} is linked from another file: make a library override of it (Object > Library Override)"
        )
    check_joints(armature)


def current_pose(armature: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Joint rotations [24, 3, 3] and translation [3], metres, y up, of the bones without constraints.

    Raises ValueError where one of SMPL's joints is missing.
    """
    rest = rest_rotations(armature)
    bases = [armature.pose.bones[name].matrix_basis for name in JOINT_NAMES]
    local = np.array([np.array(basis.to_quaternion().to_matrix()) for basis in bases], np.float64)
    world = rest @ local @ np.swapaxes(rest, -1, -2)
    rotations = BLENDER_FROM_BACKEND.T @ world @ BLENDER_FROM_BACKEND
    return rotations, points_to_backend(rest[0] @ np.array(bases[0].translation))


def world_posture(armature: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """An armature in the world as the backend describes it: axis-angle vectors [24, 3] and a translation [3], metres,
    y up, with the object's own place and turn in both.

    Raises ValueError for an armature without SMPL's joints, or scaled.
    """
    turn, place = _rigid(armature)
    rotations, translation = current_pose(armature)
    rotations[0] = turn @ rotations[0]
    rest = rest_joints(armature)[0]
    return to_axis_angle(rotations), turn @ (rest + translation) + _origin(armature, turn, place) - rest


def take_world_posture(armature: bpy.types.Object, pose: NDArray, translation: NDArray) -> None:
    """Pose an armature, and move the object, which keeps its turn, so that it is in this posture of `world_posture`.

    Raises ValueError as `world_posture` and `check_posable` do. Makes no undo step.
    """
    check_posable(armature)
    turn, _ = _rigid(armature)
    rest = rest_joints(armature)[0]
    pose = np.array(pose, np.float64)
    pose[0] = to_axis_angle(turn.T @ from_axis_angle(pose[0]))
    pose_from_joint_rotations(armature, from_axis_angle(pose))
    moved = translation + rest - turn @ rest
    matrix = np.array(armature.matrix_world)
    matrix[:3, 3] = points_to_blender(moved) - matrix[:3, :3] @ model_origin(armature.data)
    armature.matrix_world = Matrix(matrix.tolist())


def _rigid(armature: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The object's turn [3, 3] and place [3], y up."""
    matrix = np.array(armature.matrix_world, np.float64)
    linear = matrix[:3, :3]
    if np.abs(linear.T @ linear - np.eye(3)).max() > _UNSCALED or np.linalg.det(linear) < 0:
        raise ValueError(f"the armature {armature.name!r} is scaled: set its scale to 1 to fit it to a picture")
    return BLENDER_FROM_BACKEND.T @ linear @ BLENDER_FROM_BACKEND, points_to_backend(matrix[:3, 3])


def _origin(armature: bpy.types.Object, turn: NDArray, place: NDArray) -> NDArray[np.float64]:
    """Where the object puts the origin of the body model, y up."""
    return turn @ points_to_backend(model_origin(armature.data)) + place
