"""Poses of armatures with SMPL's joints: the built-in ones, reading and applying them, and the user's own.

The user's own poses are a folder with a JSON file and a picture for each, which can be copied to other computers.
"""

from __future__ import annotations

import contextlib
import functools
import json
import re
from collections.abc import Collection
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..formats.arrays import all_finite
from ..formats.joints import JOINT_NAMES
from ..formats.json_files import read_json
from ..formats.poses.rotation import from_axis_angle, matrix_to_quaternion, slerp, to_axis_angle
from ..formats.regular_files import FileError, as_file_error, remove_file
from ..formats.whole_files import write_atomically
from ..scene.armature import bone_bases, model_origin, rest_rotations
from ..scene.convention import BLENDER_FROM_BACKEND, points_to_backend, points_to_blender
from ..scene.handles import key_handles
from .adjust import leg_ratio
from .poses import LIBRARY, grounding

_MIRROR = np.array([1.0, -1.0, -1.0])
"""Signs of an axis-angle vector when left and right are swapped."""
_UNSCALED = 1e-3
SUFFIX = ".pose.json"
PICTURE_SUFFIX = ".pose.png"
_LONGEST_NAME = 60
_LARGEST_NUMBER = 1e6


@functools.cache
def builtin_poses() -> dict[str, NDArray[np.float64]]:
    """Built-in poses by name: axis-angle vectors [24, 3], radians, y up, relative to the parents. Do not modify."""
    return {name: to_axis_angle(pose.rotations()) for name, pose in LIBRARY.items()}


def mirrored(pose: NDArray) -> NDArray[np.float64]:
    """A pose [24, 3] with left and right swapped."""
    names = [_other_side(name) for name in JOINT_NAMES]
    return np.asarray(pose, np.float64)[[JOINT_NAMES.index(name) for name in names]] * _MIRROR


def rest_joints(armature: bpy.types.Object) -> NDArray[np.float64]:
    """SMPL's joints at rest [24, 3] in the body model's space, y up, in the armature's units. Raises ValueError as
    `rest_rotations`."""
    rest_rotations(armature)
    heads = np.array([armature.data.bones[name].head_local for name in JOINT_NAMES], np.float64)
    return points_to_backend(heads - model_origin(armature.data))


def check_posable(armature: bpy.types.Object) -> None:
    """Raises ValueError, in a sentence, where the armature cannot be posed or keyed now."""
    if armature.library is not None:
        raise ValueError(
            f"{armature.name!r} is linked from another file: make a library override of it (Object > Library Override)"
        )
    if armature.mode == "EDIT":
        raise ValueError(f"{armature.name!r} is in Edit Mode: leave it (Tab) first")
    rest_rotations(armature)


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


def standing(armature: bpy.types.Object, pose: NDArray) -> NDArray[np.float64]:
    """The translation [3] by which an armature in a pose [24, 3] stands on the floor."""
    return grounding(from_axis_angle(pose)[None])[0] * leg_ratio(rest_joints(armature))


def apply_pose(
    armature: bpy.types.Object,
    pose: NDArray,
    translation: NDArray | None = None,
    amount: float = 1.0,
    joints: Collection[str] = JOINT_NAMES,
) -> list[str]:
    """Give an armature a pose [24, 3] and, if given, a translation [3] (y up, metres); returns the bones changed.

    `amount` from 0 to 1 blends from the current pose to the new one. Only `joints` are changed, the whole body is moved
    only with the pelvis among them, and bones with fully locked rotation stay. Raises ValueError as
    `check_posable` does, and where the pose has another shape.
    """
    check_posable(armature)
    pose = np.asarray(pose, np.float64)
    if pose.shape != (len(JOINT_NAMES), 3) or not all_finite(pose):
        raise ValueError(f"a pose is {len(JOINT_NAMES)} axis-angle vectors of finite numbers, not {pose.shape}")
    now, place = current_pose(armature)
    target = place if translation is None else np.asarray(translation, np.float64)
    rest = rest_rotations(armature)
    target_bases, _ = bone_bases(rest, from_axis_angle(pose), target)
    current, _ = bone_bases(rest, now, place)
    quaternions = slerp(current, target_bases, amount)
    changed = []
    for name, quaternion in zip(JOINT_NAMES, quaternions, strict=True):
        bone = armature.pose.bones[name]
        if name not in joints or all(bone.lock_rotation):
            continue
        bone.rotation_mode = "QUATERNION"
        bone.rotation_quaternion = quaternion
        changed.append(name)
    if JOINT_NAMES[0] in changed and translation is not None:
        _, location = bone_bases(rest, now, place + amount * (target - place))
        armature.pose.bones[JOINT_NAMES[0]].location = location
    return changed


def key_pose(armature: bpy.types.Object, frame: float, joints: Collection[str] = JOINT_NAMES) -> None:
    """Insert keyframes of the current pose, and of IK handles. Raises ValueError as `check_posable` does."""
    check_posable(armature)
    for name in joints:
        bone = armature.pose.bones[name]
        if bone.rotation_mode != "QUATERNION":
            quaternion = matrix_to_quaternion(np.array(bone.matrix_basis.to_quaternion().to_matrix()))
            bone.rotation_mode = "QUATERNION"
            bone.rotation_quaternion = quaternion
        bone.keyframe_insert("rotation_quaternion", frame=frame, group=name)
        if name == JOINT_NAMES[0]:
            bone.keyframe_insert("location", frame=frame, group=name)
    key_handles(armature, frame)


def selected_joints(armature: bpy.types.Object) -> list[str]:
    """SMPL's joints whose bones are selected."""
    bones = armature.pose.bones
    return [name for name in JOINT_NAMES if name in bones and bones[name].select]


def _other_side(name: str) -> str:
    side, _, part = name.partition("_")
    return {"left": f"right_{part}", "right": f"left_{part}"}.get(side, name)


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


def own_poses(folder: Path) -> dict[str, Path]:
    """The poses in a folder, sorted: name -> file; none where the folder does not exist."""
    return {path.name.removesuffix(SUFFIX): path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def picture_of(pose: Path) -> Path:
    """Path of the picture beside the file of a pose, which need not exist."""
    return pose.with_name(pose.name.removesuffix(SUFFIX) + PICTURE_SUFFIX)


def delete_pose(pose: Path) -> None:
    """Remove the file of a pose, with its picture. Raises OSError where the file stays."""
    remove_file(pose, pose.parent)
    with contextlib.suppress(OSError):  # without the pose it is not shown
        remove_file(picture_of(pose), pose.parent)


def save_pose(folder: Path, name: str, pose: NDArray, translation: NDArray) -> Path:
    """Write a pose [24, 3] (axis-angle, radians) with its translation [3] (metres), both y up; returns the file.

    `formats.poses.files` reads the file too (`pose`, `transl`). Raises ValueError for a name that is empty, taken or
    not a valid file name, and FileError where the folder cannot be written to.
    """
    name = name.strip()
    if not name or len(name) > _LONGEST_NAME or re.search(r'[\\/:*?"<>|\x00-\x1f]', name) or name.startswith("."):
        raise ValueError(
            f"a pose cannot be called {name!r}: give it a name of at most {_LONGEST_NAME} letters without any of "
            r'\ / : * ? " < > |'
        )
    path = folder / f"{name}{SUFFIX}"
    if path.exists():
        raise ValueError(f"there is a pose {name!r} already: give another name, or delete that one first")
    content = {"name": name, "pose": np.round(pose, 6).tolist(), "transl": np.round(translation, 6).tolist()}
    try:
        write_atomically(path, json.dumps(content, indent=1))
    except OSError as error:
        reason = f"cannot be written ({error.strerror or error})"
        raise FileError(path, reason, "free disk space, or make its folder writable") from error
    return path


def load_pose(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The pose [24, 3] and the translation [3] in a file. Raises FileError where there is none."""
    with as_file_error(path, "cannot be read as a pose", "save the pose again", OSError):
        content = read_json(path)
        pose = np.asarray(content["pose"], np.float64)
        translation = np.asarray(content["transl"], np.float64)
    finite = all((np.abs(values) < _LARGEST_NUMBER).all() for values in (pose, translation))  # false for NaN
    if pose.shape != (24, 3) or translation.shape != (3,) or not finite:
        raise FileError(path, "holds no pose of 24 joints", "save the pose again")
    return pose, translation
