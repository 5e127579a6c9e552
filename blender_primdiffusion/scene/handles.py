"""IK handles: control bones for hands and feet, with poles for elbows and knees; and back to SMPL's joints.

A handle has no parent, so a foot stays where it is while the pelvis moves. The joints keep their own rotations below
the constraints: Blender's solver starts from these, and ends there as long as no handle is moved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import bpy
import numpy as np
from mathutils import Matrix, Quaternion, Vector

from .actions import action_curves, frames_in_use, own_curves, posed_on
from .armature import CONTROLS, LIMBS, POLE_M, Limb, editing_bones, place_controls, rest_rotations

COLLECTION = "IK Handles"
"""Bone collection of handles and poles."""
_MOVED = tuple(joint for limb in LIMBS for joint in limb.joints)
_TURN = "rotation_quaternion"
_JOINT_KEYS = dict.fromkeys(_MOVED, (_TURN,))
_CONTROL_KEYS = {limb.handle: ("location", _TURN) for limb in LIMBS} | {limb.pole: ("location",) for limb in LIMBS}
_STIFFNESS = 0.9
"""Stiffness of elbows and knees against twisting and bending sideways, which Blender's solver does not avoid."""
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
    poses = [_joints(shown) for shown in posed_on(context, armature, frames or [context.scene.frame_current])]
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
    _pose_on(armature, frames, [partial(_put_controls, armature, pose) for pose in poses], _CONTROL_KEYS)


def bake_handles(context: bpy.types.Context, armature: bpy.types.Object) -> None:
    """Give the joints the rotations that handles show, on each frame where the pose is animated, and remove the handles
    with their keys. Raises ValueError for an armature that has none, or whose bones cannot be changed now."""
    _check_bones(armature)
    if not has_handles(armature):
        raise ValueError(f"{armature.name!r} has no IK handles: press Add IK Handles first")
    frames = frames_in_use(armature)
    poses = [_turns(shown) for shown in posed_on(context, armature, frames or [context.scene.frame_current])]
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
        for constraint in [one for one in end.constraints if getattr(one, "subtarget", "") == limb.handle]:
            end.constraints.remove(constraint)
    _remove_curves(armature, _CONTROL_KEYS)
    _pose_on(armature, frames, [partial(_turn_joints, armature, pose) for pose in poses], _JOINT_KEYS)


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


def _bend_axis(armature: bpy.types.Object, limb: Limb) -> Vector:
    """See `Limb.bend_axis`."""
    return Vector(limb.bend_axis(np.array(armature.data.bones[limb.root].matrix_local.to_3x3())))


def _joints(shown: bpy.types.Object) -> dict[str, Matrix]:
    """The joints that handles move, in the armature's space."""
    return {name: shown.pose.bones[name].matrix.copy() for name in _MOVED}


def _turns(shown: bpy.types.Object) -> dict[str, Quaternion]:
    """The rotations that pose the same joints as they are shown, without constraints."""
    spaces = {"from_space": "POSE", "to_space": "LOCAL"}
    bones = [shown.pose.bones[name] for name in _MOVED]
    return {b.name: shown.convert_space(pose_bone=b, matrix=b.matrix, **spaces).to_quaternion() for b in bones}


def _pose_on(
    armature: bpy.types.Object, frames: range, poses: Sequence[Callable[[], None]], keys: Mapping[str, Sequence[str]]
) -> None:
    """Take each pose and key these properties of bones on its frame, in place of their keys; or take the only one."""
    if frames:
        own_curves(armature)
        _remove_curves(armature, keys)
    for number, take in enumerate(poses):
        take()
        for name, channels in keys.items() if frames else ():
            for channel in channels:
                armature.pose.bones[name].keyframe_insert(channel, frame=frames[number], group=name)


def _remove_curves(armature: bpy.types.Object, keys: Mapping[str, Sequence[str]]) -> None:
    paths = {f'pose.bones["{name}"].{channel}' for name, channels in keys.items() for channel in channels}
    for curve in [curve for curve in action_curves(armature) or () if curve.data_path in paths]:
        action_curves(armature).remove(curve)


def _turn_joints(armature: bpy.types.Object, turns: Mapping[str, Quaternion]) -> None:
    for name, turn in turns.items():
        _turn(armature.pose.bones[name], turn)


def _turn(bone: bpy.types.PoseBone, turn: Quaternion) -> None:
    """Of q and -q, which are the same turn, the one nearer to the bone's, since Blender interpolates components."""
    bone.rotation_mode = "QUATERNION"
    near = turn.copy()
    near.make_compatible(bone.rotation_quaternion)
    bone.rotation_quaternion = near


def _put_controls(armature: bpy.types.Object, pose: Mapping[str, Matrix]) -> None:
    """Put handles and poles where joints with these matrices need them."""
    for limb in LIMBS:
        root, middle, end = (pose[name] for name in limb.joints)
        handle, pole = (armature.pose.bones[name] for name in (limb.handle, limb.pole))
        basis = handle.bone.matrix_local.inverted() @ end
        handle.location = basis.translation
        _turn(handle, basis.to_quaternion())
        place = _pole_place(root, middle, end, _bend_axis(armature, limb))
        pole.location = pole.bone.matrix_local.inverted() @ place


def _pole_place(root: Matrix, middle: Matrix, end: Matrix, axis: Vector) -> Vector:
    """The place of a pole that leaves a limb with these matrices as it is.

    Blender turns the limb about the line from root to end until `axis`, in the root's space, is in the half-plane of
    line and pole.
    """
    line, side = end.translation - root.translation, root.to_3x3() @ axis
    side = (side - side.project(line)).normalized()
    return root.translation + (middle.translation - root.translation).project(line) + POLE_M * side
