"""Poses: built-in ones on the floor, diverse ones picked from motion, and those of armatures with SMPL's joints."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..formats.poses.motion import Motion, built_in_vectors
from ..formats.poses.rotation import about_axis, from_axis_angle, to_axis_angle
from ..formats.poses.skeleton import REST_JOINTS, joint_positions
from ..scene.armature import check_joints, model_origin, pose_from_joint_rotations, rest_rotations
from ..scene.convention import BLENDER_FROM_BACKEND, points_to_backend, points_to_blender

FLOOR = -1.168
"""Height of the soles at rest, metres."""
_CLEARANCE = REST_JOINTS[:, 1] - FLOOR
_TOUCHING = {"knee": 0.06, "elbow": 0.04, "wrist": 0.03, "hand": 0.03, "pelvis": 0.12, "head": 0.12}
"""Metres from joints to the skin below them; ankles and feet have their rest height."""
_POOL = 1000
"""Number of frames from which poses are picked."""
_NEAR_T_M = 0.08
"""Mean distance of the joints from the first built-in pose up to which a frame counts as near T."""


def built_in_poses(count: int) -> Motion:
    """The first `count` built-in poses, feet on the floor. Raises ValueError where there are fewer."""
    poses = np.array(list(built_in_vectors().values()))
    if not 1 <= count <= len(poses):
        raise ValueError(f"there are 1 to {len(poses)} built-in poses, not {count}: give files for more")
    rotations = from_axis_angle(poses[:count])
    return Motion(rotations, grounding(rotations), 1.0, "built-in")


def grounding(rotations: NDArray) -> NDArray[np.float64]:
    """Vertical translations [F, 3] that put the lowest part of the average body on its floor at rest."""
    joints = joint_positions(rotations)
    clearance = np.array(
        [
            _CLEARANCE[joint] if name.split("_")[-1] in ("ankle", "foot") else _TOUCHING.get(name.split("_")[-1], 0.1)
            for joint, name in enumerate(JOINT_NAMES)
        ]
    )
    down = FLOOR - (joints[..., 1] - clearance).min(-1)
    return np.stack([np.zeros_like(down), down, np.zeros_like(down)], -1)


def pick_poses(motions: Sequence[Motion], count: int, seed: int = 0) -> Motion:
    """`count` poses from the frames of all motions, near-T first, the others as different as possible.

    Each next pose is the one farthest from those picked (farthest-point sampling over joint positions about the pelvis,
    regardless of heading). Where no frame is near a T pose, the built-in one is the first. Poses are put on the floor
    at the origin. The same seed picks the same poses.

    Raises ValueError where the motions have too few frames.
    """
    rotations = np.concatenate([motion.rotations for motion in motions]) if motions else np.zeros((0, 24, 3, 3))
    if len(rotations) < count - 1 or count < 1:
        raise ValueError(
            f"{count} poses cannot be picked from {len(rotations)} frames: give more files, or ask for fewer poses"
        )
    first = built_in_poses(1).rotations
    from_t = _distance(_about_pelvis(rotations), _about_pelvis(first)[0])
    has_t = len(rotations) >= count and from_t.min() < _NEAR_T_M
    if has_t:
        first = rotations[[int(from_t.argmin())]]
    if len(rotations) > _POOL:
        chosen = np.random.default_rng(seed).choice(len(rotations), _POOL, replace=False)
        rotations = rotations[np.sort(chosen)]
    rotations = np.concatenate([first, rotations])
    places, picked = _about_pelvis(rotations), [0]
    distance = _distance(places, places[0])
    while len(picked) < count:
        distance[picked] = -1.0
        picked.append(int(distance.argmax()))
        distance = np.minimum(distance, _distance(places, places[picked[-1]]))
    poses = rotations[picked]
    names = ", ".join(dict.fromkeys(motion.name for motion in motions))
    return Motion(poses, grounding(poses), 1.0, names)


def _about_pelvis(rotations: NDArray) -> NDArray[np.float64]:
    """Joints [F, 24, 3] relative to the pelvis, turned about the vertical to face +z."""
    front = rotations[:, 0, :, 2]
    unturned = np.array(rotations)
    unturned[:, 0] = about_axis(1, -np.arctan2(front[:, 0], front[:, 2])) @ rotations[:, 0]
    return joint_positions(unturned) - REST_JOINTS[0]


def _distance(places: NDArray, place: NDArray) -> NDArray[np.float64]:
    """Mean distance of the joints [F] between poses [F, 24, 3] and one pose [24, 3], metres."""
    return np.linalg.norm(places - place, axis=-1).mean(-1)


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
