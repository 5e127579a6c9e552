"""SMPL's skeleton as a Blender armature; poses given as SMPL joint rotations, and keyframes of many; and the limbs that
IK handles move, with the bones that `handles` adds for them.

Actions have one layer, strip and slot, the same in Blender 5.0 to 5.3.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES, PARENTS
from ..formats.poses.rotation import matrix_to_quaternion
from .actions import action_curves, new_action
from .blend_values import stored_numbers
from .convention import continuous_quaternions, points_to_blender, rotations_to_blender
from .human import ORIGIN

_POINTS_TO = {"pelvis": "spine1", "spine3": "neck"}
"""The child that a bone points to, where a joint has several."""
_LEAF_LENGTH = {"head": 0.15, "left_foot": 0.06, "right_foot": 0.06, "left_hand": 0.08, "right_hand": 0.08}
_LEAF_DIRECTION = {"head": (0.0, 0.0, 1.0), "left_foot": (0.0, -1.0, 0.0), "right_foot": (0.0, -1.0, 0.0)}
_SHORTEST = 0.01
POLE_M = 0.4
"""From the limb to its pole, metres."""
_HANDLE_M, _POLE_LENGTH_M = 0.2, 0.1


def floor_below(vertices: NDArray) -> NDArray[np.float64]:
    """The displacement [3] that puts the soles of a body at rest, vertices [V, 3], on z = 0: see `human.ORIGIN`."""
    return np.array([0.0, 0.0, -vertices[:, 2].min()])


def bone_tails(joints: NDArray) -> NDArray[np.float64]:
    """Tails [24, 3] of bones with heads at `joints` [24, 3], z up: at the child, or straight on for leaves."""
    tails = np.array(joints, np.float64)
    for index, name in enumerate(JOINT_NAMES):
        children = [child for child, parent in enumerate(PARENTS) if parent == index]
        if children:
            target = JOINT_NAMES.index(_POINTS_TO[name]) if name in _POINTS_TO else children[0]
            offset = joints[target] - joints[index]
        else:
            direction = np.asarray(_LEAF_DIRECTION.get(name, joints[index] - joints[PARENTS[index]]), np.float64)
            offset = direction / max(float(np.linalg.norm(direction)), 1e-9) * _LEAF_LENGTH[name]
        if np.linalg.norm(offset) < _SHORTEST:  # Blender deletes bones of no length when edit mode ends
            offset = np.array([0.0, 0.0, _SHORTEST])
        tails[index] = joints[index] + offset
    return tails


def build_armature(name: str, joints: NDArray) -> bpy.types.Object:
    """An armature object with a bone for each joint, heads at `joints` [24, 3] (z up, metres), linked to no collection.

    Modes, selection and the active object stay as they are.
    """
    data = bpy.data.armatures.new(name)
    armature = bpy.data.objects.new(name, data)
    with _in_edit_mode(armature):
        tails = bone_tails(joints)
        for index, joint in enumerate(JOINT_NAMES):
            bone = data.edit_bones.new(joint)
            bone.head, bone.tail = Vector(joints[index]), Vector(tails[index])
            forward = bone.vector.normalized().y < -0.9  # the feet: their roll needs another direction than -y
            bone.align_roll((0.0, 0.0, 1.0) if forward else (0.0, -1.0, 0.0))
            if PARENTS[index] >= 0:
                bone.parent = data.edit_bones[JOINT_NAMES[PARENTS[index]]]
    data.display_type = "STICK"
    for bone in armature.pose.bones:
        bone.rotation_mode = "QUATERNION"
    return armature


def move_rest_joints(data: bpy.types.Armature, joints: NDArray) -> None:
    """Move an armature's bones to other rest joints [24, 3] (z up, metres), and IK handles with them; poses and other
    additional bones stay.

    Bones are moved but not turned towards the new joints: with the same axes, a pose or an animation means the same
    joint rotations as before. Modes, selection and the active object stay too. For an armature that has passed
    `check_joints`.
    """
    with editing_bones(data) as bones:
        for name, joint in zip(JOINT_NAMES, joints, strict=True):
            bone = bones[name]
            along, bone.head = bone.tail - bone.head, Vector(joint)
            bone.tail = bone.head + along
        place_controls(bones)


@contextmanager
def editing_bones(data: bpy.types.Armature) -> Iterator[bpy.types.ArmatureEditBones]:
    """The bones of an armature that is not in edit mode, to change them; modes, selection and the active object of the
    user's scenes stay."""
    mirrored, data.use_mirror_x = data.use_mirror_x, False
    carrier = bpy.data.objects.new("PrimDiffusion Bones", data)
    try:
        with _in_edit_mode(carrier):
            yield data.edit_bones
    finally:
        bpy.data.objects.remove(carrier)
        data.use_mirror_x = mirrored


@contextmanager
def _in_edit_mode(armature: bpy.types.Object) -> Iterator[None]:
    """Put an armature object that is in no scene into edit mode, in a temporary scene.

    Edit mode evaluates its scene twice, which takes half a second with a human's thousand volumes and milliseconds
    without. The user's scene may also be in another mode, or hide the human.
    """
    scene = bpy.data.scenes.new("PrimDiffusion Bones")
    try:
        scene.collection.objects.link(armature)
        layer = scene.view_layers[0]
        layer.objects.active = armature
        with bpy.context.temp_override(scene=scene, view_layer=layer, active_object=armature, object=armature):
            bpy.ops.object.mode_set(mode="EDIT")
            try:
                yield
            finally:
                bpy.ops.object.mode_set(mode="OBJECT")
    finally:
        bpy.data.scenes.remove(scene)


def model_origin(data: bpy.types.Armature) -> NDArray[np.float64]:
    """Where the origin of the body model is in the space of these bones [3], metres, z up: see `human.ORIGIN`."""
    return np.array(stored_numbers(data, ORIGIN, 3) or (0.0, 0.0, 0.0))


def check_joints(armature: bpy.types.Object) -> None:
    """Raises ValueError for an armature that lacks one of SMPL's joints or is in Edit Mode."""
    missing = [name for name in JOINT_NAMES if name not in armature.data.bones]
    if missing:
        raise ValueError(f"the armature {armature.name!r} has no bone {missing[0]!r}: give it this name again")
    if armature.data.is_editmode:
        raise ValueError(f"{armature.name!r} is in Edit Mode: leave it (Tab) first")


def rest_rotations(armature: bpy.types.Object) -> NDArray[np.float64]:
    """Rest axes of the bones [24, 3, 3] in the armature's space, in SMPL's joint order. Raises as `check_joints`."""
    check_joints(armature)
    bones = armature.data.bones
    return np.array([np.array(bones[name].matrix_local.to_3x3()) for name in JOINT_NAMES], np.float64)


def bone_bases(rest: NDArray, rotations: NDArray, translation: NDArray) -> tuple[NDArray, NDArray]:
    """Pose-bone quaternions [*b, 24, 4] (w first) and the pelvis bone's location [*b, 3] for SMPL joint rotations.

    `rotations` [*b, 24, 3, 3] turn each joint about itself along the world's rest axes, y up, and `translation` [*b, 3]
    moves the whole human. A bone's own axes O at rest differ, so its basis is O^T R O: then Blender's bone matrix is
    G_j B_j with SMPL's skinning transform G_j and the bone's rest matrix B_j, whatever O is.
    """
    inverse = np.swapaxes(rest, -1, -2)
    local = inverse @ rotations_to_blender(rotations) @ rest
    return matrix_to_quaternion(local), points_to_blender(translation) @ rest[0]


def pose_from_joint_rotations(
    armature: bpy.types.Object, rotations: NDArray, translation: NDArray | None = None
) -> None:
    """Pose the bones by SMPL joint rotations [24, 3, 3] and a translation [3] in metres, y up."""
    shift = np.zeros(3) if translation is None else translation
    quaternions, location = bone_bases(rest_rotations(armature), np.asarray(rotations), shift)
    for name, quaternion in zip(JOINT_NAMES, quaternions, strict=True):
        bone = armature.pose.bones[name]
        bone.rotation_mode = "QUATERNION"
        bone.rotation_quaternion = quaternion
        bone.scale = (1.0, 1.0, 1.0)
        bone.location = location if name == JOINT_NAMES[0] else (0.0, 0.0, 0.0)


_LINEAR = 1
"""Value of LINEAR in the enumeration Keyframe.interpolation, as foreach_set wants it."""


def keyframe_poses(
    armature: bpy.types.Object, frames: NDArray, rotations: NDArray, translations: NDArray, name: str = "Motion"
) -> bpy.types.Action:
    """Give the armature a new action with SMPL joint rotations [F, 24, 3, 3] and translations [F, 3] (y up, metres) at
    `frames` [F].

    Frames may be fractional and must increase. Keys are linear, so that motion sampled every frame is exact; between
    keys, Blender interpolates the components of quaternions. Raises ValueError when the lengths differ or frames do not
    increase.
    """
    channels = _channels(armature, frames, rotations, translations)
    action = new_action(armature, name)
    curves = action_curves(armature)
    for (path, index), values in channels.items():
        add_keys(curves.new(path, index=index), frames, values)
    _use_quaternions(armature)
    return action


def _channels(
    armature: bpy.types.Object, frames: NDArray, rotations: NDArray, translations: NDArray
) -> dict[tuple[str, int], NDArray[np.float64]]:
    """Values [F] by the data path and index of a curve. Raises ValueError as `keyframe_poses`."""
    times = np.asarray(frames, np.float64)
    shapes = (times.shape[0], len(JOINT_NAMES), 3, 3), (times.shape[0], 3)
    if times.ndim != 1 or np.shape(rotations) != shapes[0] or np.shape(translations) != shapes[1]:
        raise ValueError(
            f"poses have shapes {np.shape(rotations)} and {np.shape(translations)}; {times.shape[0]} frames "
            f"need {shapes[0]} and {shapes[1]}"
        )
    if times.size == 0 or np.any(np.diff(times) <= 0):
        raise ValueError("frame numbers must increase from key to key; sort them and drop duplicates")
    quaternions, location = bone_bases(rest_rotations(armature), np.asarray(rotations), np.asarray(translations))
    quaternions = continuous_quaternions(quaternions)
    channels = {
        (f'pose.bones["{bone}"].rotation_quaternion', component): quaternions[:, joint, component]
        for joint, bone in enumerate(JOINT_NAMES)
        for component in range(4)
    }
    path = f'pose.bones["{JOINT_NAMES[0]}"].location'
    return channels | {(path, axis): location[:, axis] for axis in range(3)}


def _use_quaternions(armature: bpy.types.Object) -> None:
    for name in JOINT_NAMES:
        armature.pose.bones[name].rotation_mode = "QUATERNION"


def add_keys(curve: bpy.types.FCurve, times: NDArray, values: NDArray) -> None:
    """Append linear keys to a curve."""
    points = curve.keyframe_points
    count = len(points)
    points.add(len(times))
    coordinates, kinds = np.empty(2 * len(points), np.float32), np.empty(len(points), np.int32)
    points.foreach_get("co", coordinates)
    points.foreach_get("interpolation", kinds)
    coordinates[2 * count :] = np.stack([times, values], -1).ravel()
    kinds[count:] = _LINEAR
    points.foreach_set("co", coordinates)
    points.foreach_set("interpolation", kinds)
    curve.update()


@dataclasses.dataclass(frozen=True)
class Limb:
    """Two bones that reach for a handle and bend towards a pole."""

    root: str
    """SMPL's joint, as the next two."""
    middle: str
    end: str
    """Turns as the handle does."""
    handle: str
    """A bone without a parent, with the rest axes of `end`."""
    pole: str
    """A bone without a parent."""
    tip: str
    """A child of `middle`, from there to `end`: the middle bone's own tail leaves the joint when the shape changes."""
    bend: tuple[float, float, float]
    """Where the middle goes at rest when the limb bends, z up."""

    @property
    def joints(self) -> tuple[str, str, str]:
        """The joints that the handle moves."""
        return self.root, self.middle, self.end

    @property
    def controls(self) -> tuple[str, str, str]:
        """The bones that are added for the limb."""
        return self.handle, self.pole, self.tip

    def bend_axis(self, rest: NDArray) -> NDArray[np.float64]:
        """The axis of the root's bone, in its own space [3], that Blender turns to the pole; orthogonal to the bone.

        `rest` [3, 3] are the root's axes at rest.
        """
        x, _, z = np.asarray(rest, np.float64).T @ self.bend
        return np.array([x, 0.0, z]) / np.hypot(x, z)


def _limbs() -> Iterator[Limb]:
    for side in ("left", "right"):
        for root, middle, end, name, bend in (
            ("hip", "knee", "ankle", "foot", (0.0, -1.0, 0.0)),
            ("shoulder", "elbow", "wrist", "hand", (0.0, 1.0, 0.0)),
        ):
            controls = (f"{side}_{name}_ik", f"{side}_{middle}_pole", f"{side}_{name}_tip")
            yield Limb(f"{side}_{root}", f"{side}_{middle}", f"{side}_{end}", *controls, bend)


LIMBS = tuple(_limbs())
CONTROLS = tuple(name for limb in LIMBS for name in limb.controls)


def place_controls(bones: bpy.types.ArmatureEditBones) -> None:
    """Put the controls that there are where the joints are at rest. Handles keep their axes, so that poses and keys
    mean the same distances from rest and the same turns."""
    for limb in LIMBS:
        middle, end = bones[limb.middle].head.copy(), bones[limb.end].head.copy()
        if handle := bones.get(limb.handle):
            _put(handle, end, bones[limb.end].vector.normalized() * _HANDLE_M)
        if pole := bones.get(limb.pole):
            _put(pole, middle + Vector(limb.bend) * POLE_M, Vector((0.0, 0.0, _POLE_LENGTH_M)))
        if tip := bones.get(limb.tip):
            _put(tip, middle, end - middle)


def _put(bone: bpy.types.EditBone, head: Vector, along: Vector) -> None:
    bone.head, bone.tail = head, head + along
