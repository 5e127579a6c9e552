"""An armature in the world as the backend describes it: SMPL's pose, translation and shape, y up."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..formats.poses.rotation import from_axis_angle, to_axis_angle
from ..scene.armature import model_origin
from ..scene.convention import BLENDER_FROM_BACKEND, points_to_backend, points_to_blender
from .pose_library import apply_pose, check_posable, current_pose, rest_joints

_UNSCALED = 1e-3


def world_posture(armature: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Axis-angle vectors [24, 3] and a translation [3], metres, with the object's own place and turn in both.

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
    apply_pose(armature, pose, np.zeros(3))
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
