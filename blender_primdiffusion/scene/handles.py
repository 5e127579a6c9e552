"""IK handles: control bones for hands and feet, with poles for elbows and knees; and back to SMPL's joints.

A handle has no parent, so a foot stays where it is while the pelvis moves. The joints keep their own rotations below
the constraints: Blender's solver starts from these, and ends there as long as no handle is moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..formats.poses.rotation import matrix_to_quaternion, nearest
from .actions import action_curves, frames_in_use, loops, own_curves, repeat
from .armature import CONTROLS, LIMBS, POLE_M, Limb, add_keys, editing_bones, place_controls, rest_rotations
from .convention import continuous_quaternions
from .export_model import scene_with_only

COLLECTION = "IK Handles"
"""Of bones: handles and poles."""
_MOVED = tuple(joint for limb in LIMBS for joint in limb.joints)
_STIFFNESS = 0.9
"""Of elbows and knees against twisting and bending sideways, which Blender's solver would do as readily."""
_COLOUR = "THEME09"
_BOX_M = {"handle": 0.02, "pole": 0.015}


def has_handles(armature: bpy.types.Object) -> bool:
    """Whether an armature has IK handles, or some of their bones."""
    return any(name in armature.data.bones for name in CONTROLS)


def check_no_handles(armature: bpy.types.Object) -> None:
    """Raises ValueError for an armature with IK handles."""
    if has_handles(armature):
        raise ValueError(
            f"{armature.name!r} has IK handles, which hold its hands and feet: press Bake and Remove Handles first"
        )


def add_handles(context: bpy.types.Context, armature: bpy.types.Object) -> None:
    """Add handles where hands and feet are; the pose stays, on each frame where it is animated.

    Raises ValueError for an armature that has handles or lacks joints, or whose bones cannot be changed now.
    """
    _check_bones(armature)
    check_no_handles(armature)
    rest_rotations(armature)
    frames = frames_in_use(armature)
    matrices = _joint_matrices(context, armature, frames)
    with editing_bones(_own_bones(armature)) as bones:
        for limb in LIMBS:
            for name in limb.controls:
                bones.new(name).use_deform = False
            bones[limb.tip].parent = bones[limb.middle]
        place_controls(bones)
        for limb in LIMBS:
            bones[limb.handle].roll = bones[limb.end].roll
    for limb in LIMBS:
        _show(armature, limb)
        _constrain(armature, limb)
    _pose_controls(armature, frames, matrices)


def bake_handles(context: bpy.types.Context, armature: bpy.types.Object) -> None:
    """Give the joints the rotations that handles show, on each frame where the pose is animated, and remove the handles
    with their keys. Raises ValueError for an armature that has none, or whose bones cannot be changed now."""
    _check_bones(armature)
    if not has_handles(armature):
        raise ValueError(f"{armature.name!r} has no IK handles: press Add IK Handles first")
    frames = frames_in_use(armature)
    rotations = _joint_rotations(context, armature, frames)
    data = _own_bones(armature)
    with editing_bones(data) as bones:
        for name in CONTROLS:
            if name in bones:
                bones.remove(bones[name])
    if COLLECTION in data.collections:
        data.collections.remove(data.collections[COLLECTION])
    for limb in LIMBS:
        middle, end = (armature.pose.bones[name] for name in (limb.middle, limb.end))
        for name in ("ik_stiffness_y", "ik_stiffness_z"):
            middle.property_unset(name)
        for constraint in [one for one in end.constraints if _is_ours(one, limb)]:
            end.constraints.remove(constraint)
    _remove_keys(armature)
    _pose_joints(armature, frames, rotations)


def joints_from_handles(context: bpy.types.Context, armature: bpy.types.Object) -> None:
    """Give the joints, below their constraints, the rotations that handles show now; nothing without handles or to a
    linked armature."""
    if has_handles(armature) and armature.library is None:
        _pose_joints(armature, range(0), _joint_rotations(context, armature, range(0)))


def handles_from_joints(context: bpy.types.Context, armature: bpy.types.Object) -> None:
    """Put handles and poles where the joints' own rotations have the limbs; nothing without handles."""
    ours = [constraint for limb in LIMBS for constraint in _constraints(armature, limb)]
    if not all(name in armature.pose.bones for name in CONTROLS):
        return
    muted = [constraint.mute for constraint in ours]
    for constraint in ours:
        constraint.mute = True
    matrices = _joint_matrices(context, armature, range(0))
    for constraint, before in zip(ours, muted, strict=True):
        constraint.mute = before
    _pose_controls(armature, range(0), matrices)


def key_handles(armature: bpy.types.Object, frame: float) -> None:
    """Insert keyframes of handles and poles; nothing without handles."""
    for limb in LIMBS:
        for name, channels in ((limb.handle, ("location", "rotation_quaternion")), (limb.pole, ("location",))):
            if name in armature.pose.bones:
                for channel in channels:
                    armature.pose.bones[name].keyframe_insert(channel, frame=frame, group=name)


def _check_bones(armature: bpy.types.Object) -> None:
    """Raises ValueError where bones cannot be added or removed."""
    if armature.data.library is not None or armature.data.override_library is not None:
        raise ValueError(
            f"the bones of {armature.name!r} are linked from another file: change them there, or make them local with "
            "Object > Relations > Make Local > All"
        )
    if armature.data.is_editmode:
        raise ValueError(f"the armature {armature.data.name!r} is in Edit Mode: leave it (Tab) first")


def _own_bones(armature: bpy.types.Object) -> bpy.types.Armature:
    """The armature's bones, copied where other objects have them too."""
    if armature.data.users > 1:
        armature.data = armature.data.copy()
    return armature.data


def _show(armature: bpy.types.Object, limb: Limb) -> None:
    """Handle and pole in a collection, as coloured boxes; the tip hidden."""
    data = armature.data
    collection = data.collections.get(COLLECTION) or data.collections.new(COLLECTION)
    for kind, size in _BOX_M.items():
        bone = data.bones[getattr(limb, kind)]
        collection.assign(bone)
        bone.color.palette = _COLOUR
        bone.bbone_x = bone.bbone_z = size
        bone.display_type = "BBONE"
    tip = armature.pose.bones[limb.tip]
    tip.hide = True


def _constrain(armature: bpy.types.Object, limb: Limb) -> None:
    """Have the limb reach for its handle, bent towards its pole, and its end turn with the handle."""
    handle, pole, tip, middle, end = (
        armature.pose.bones[name] for name in (limb.handle, limb.pole, limb.tip, limb.middle, limb.end)
    )
    for control in (handle, pole):
        control.rotation_mode = "QUATERNION"
        control.lock_scale = (True, True, True)
    tip.lock_ik_x = tip.lock_ik_y = tip.lock_ik_z = True
    middle.ik_stiffness_y = middle.ik_stiffness_z = _STIFFNESS
    reach = tip.constraints.new("IK")
    reach.target = reach.pole_target = armature
    reach.subtarget, reach.pole_subtarget = limb.handle, limb.pole
    reach.chain_count = 3
    x, _, z = _bend_axis(armature, limb)
    reach.pole_angle = math.atan2(z, x)
    turn = end.constraints.new("COPY_ROTATION")
    turn.target, turn.subtarget = armature, limb.handle
    turn.owner_space = turn.target_space = "POSE"


def _bend_axis(armature: bpy.types.Object, limb: Limb) -> NDArray[np.float64]:
    """See `Limb.bend_axis`."""
    return limb.bend_axis(np.array(armature.data.bones[limb.root].matrix_local.to_3x3()))


def _constraints(armature: bpy.types.Object, limb: Limb) -> Iterator[bpy.types.Constraint]:
    bones = armature.pose.bones
    for name in (limb.tip, limb.end):
        if name in bones:
            yield from (constraint for constraint in bones[name].constraints if _is_ours(constraint, limb))


def _is_ours(constraint: bpy.types.Constraint, limb: Limb) -> bool:
    return getattr(constraint, "subtarget", "") == limb.handle


def _evaluated(context: bpy.types.Context, armature: bpy.types.Object, frames: range) -> Iterator[bpy.types.Object]:
    """The evaluated armature on each frame; where there are none, as it is shown now."""
    if not frames and armature.visible_get() and armature.data.pose_position == "POSE":
        yield armature.evaluated_get(context.evaluated_depsgraph_get())
        return
    with scene_with_only(context, armature) as scene:
        for frame in frames or (scene.frame_current,):
            scene.frame_set(frame)
            yield armature.evaluated_get(scene.view_layers[0].depsgraph)


def _joint_matrices(
    context: bpy.types.Context, armature: bpy.types.Object, frames: range
) -> dict[str, NDArray[np.float64]]:
    """Matrices [F, 4, 4] in the armature's space of the joints that handles move."""
    found = [
        [shown.pose.bones[name].matrix.copy() for name in _MOVED] for shown in _evaluated(context, armature, frames)
    ]
    return dict(zip(_MOVED, np.moveaxis(np.array(found, np.float64), 1, 0), strict=True))


def _joint_rotations(
    context: bpy.types.Context, armature: bpy.types.Object, frames: range
) -> dict[str, NDArray[np.float64]]:
    """Quaternions [F, 4] of the same joints that pose them as they are shown, without constraints."""
    found = []
    for shown in _evaluated(context, armature, frames):
        bones = [shown.pose.bones[name] for name in _MOVED]
        local = [
            shown.convert_space(pose_bone=bone, matrix=bone.matrix, from_space="POSE", to_space="LOCAL")
            for bone in bones
        ]
        found.append([matrix.to_quaternion() for matrix in local])
    turns = continuous_quaternions(np.array(found, np.float64))
    return dict(zip(_MOVED, np.moveaxis(turns, 1, 0), strict=True))


def _pose_joints(armature: bpy.types.Object, frames: range, rotations: Mapping[str, NDArray]) -> None:
    """Give joints these rotations [F, 4]: as keys, or without frames to the pose."""
    for name in rotations:
        armature.pose.bones[name].rotation_mode = "QUATERNION"
    if frames:
        _key(armature, frames, {name: {"rotation_quaternion": values} for name, values in rotations.items()})
        return
    for name, values in rotations.items():
        armature.pose.bones[name].rotation_quaternion = values[0]


def _pose_controls(armature: bpy.types.Object, frames: range, matrices: Mapping[str, NDArray]) -> None:
    """Put handles and poles where the joints with these matrices [F, 4, 4] need them: keyed, or without frames now."""
    keys = {}
    for limb in LIMBS:
        root, middle, end = (matrices[name] for name in limb.joints)
        handle_rest, pole_rest = (np.array(armature.data.bones[name].matrix_local) for name in (limb.handle, limb.pole))
        pole = np.tile(pole_rest, (len(end), 1, 1))
        pole[:, :3, 3] = _pole_place(root, middle, end, _bend_axis(armature, limb))
        if not frames:
            armature.pose.bones[limb.handle].matrix = Matrix(end[0])
            armature.pose.bones[limb.pole].matrix = Matrix(pole[0])
            continue
        basis = np.linalg.inv(handle_rest) @ end
        turns = continuous_quaternions(matrix_to_quaternion(nearest(basis[:, :3, :3])))
        keys[limb.handle] = {"location": basis[:, :3, 3], "rotation_quaternion": turns}
        keys[limb.pole] = {"location": (np.linalg.inv(pole_rest) @ pole)[:, :3, 3]}
    if frames:
        _key(armature, frames, keys)


def _pole_place(root: NDArray, middle: NDArray, end: NDArray, axis: NDArray) -> NDArray[np.float64]:
    """The place of a pole [F, 3] that leaves a limb with these matrices [F, 4, 4] as it is.

    Blender turns the limb about the line from root to end until `axis` [3], in the root's space, is in the half-plane
    of line and pole.
    """
    start = root[:, :3, 3]
    line = _unit(end[:, :3, 3] - start)
    side = root[:, :3, :3] @ axis
    side = _unit(side - (side * line).sum(-1, keepdims=True) * line)
    along = ((middle[:, :3, 3] - start) * line).sum(-1, keepdims=True)
    return start + along * line + POLE_M * side


def _unit(vectors: NDArray) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _key(armature: bpy.types.Object, frames: range, keys: Mapping[str, Mapping[str, NDArray]]) -> None:
    """Replace the keys of properties of bones by these values [F, n], one on each frame."""
    looped, curves = loops(armature), own_curves(armature)
    for bone, channels in keys.items():
        for name, values in channels.items():
            path = f'pose.bones["{bone}"].{name}'
            for index in range(values.shape[-1]):
                if (curve := curves.find(path, index=index)) is not None:
                    curves.remove(curve)
                add_keys(curves.new(path, index=index), np.array(frames), values[:, index])
    if looped:
        repeat(armature)


def _remove_keys(armature: bpy.types.Object) -> None:
    paths = tuple(f'pose.bones["{name}"]' for name in CONTROLS)
    for curve in [curve for curve in action_curves(armature) or () if curve.data_path.startswith(paths)]:
        action_curves(armature).remove(curve)
