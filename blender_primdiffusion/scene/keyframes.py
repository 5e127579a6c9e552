"""Many poses at once as keyframes: an action of one layer, strip and slot (the same in Blender 4.5 to 5.2)."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from .armature import bone_bases, rest_rotations
from .human_file import JOINT_NAMES
from .quaternion import continuous_quaternions

_LINEAR = 1
"""Value of LINEAR in the enumeration Keyframe.interpolation, as foreach_set wants it."""


def keyframe_poses(
    armature: bpy.types.Object, frames: NDArray, rotations: NDArray, translations: NDArray, name: str = "Motion"
) -> bpy.types.Action:
    """A new action on the armature: SMPL joint rotations [F, 24, 3, 3] and translations [F, 3] (y up, metres) at
    `frames` [F].

    Frames may be fractional and must increase. Keys are linear, so that motion sampled every frame is met exactly;
    between keys quaternions are interpolated by component. Raises ValueError when the lengths differ or frames do not
    increase.
    """
    times = np.asarray(frames, np.float64)
    shapes = (times.shape[0], len(JOINT_NAMES), 3, 3), (times.shape[0], 3)
    if times.ndim != 1 or np.shape(rotations) != shapes[0] or np.shape(translations) != shapes[1]:
        raise ValueError(
            f"poses have shapes {np.shape(rotations)} and {np.shape(translations)}; {times.shape[0]} frames "
            f"need {shapes[0]} and {shapes[1]}"
        )
    if times.size == 0 or np.any(np.diff(times) <= 0):
        raise ValueError("frame numbers must increase from key to key; sort them and drop doubles")
    quaternions, location = bone_bases(rest_rotations(armature), np.asarray(rotations), np.asarray(translations))
    quaternions = continuous_quaternions(quaternions)

    action = bpy.data.actions.new(name)
    slot = action.slots.new(id_type="OBJECT", name=armature.name)
    strip = action.layers.new("Pose").strips.new(type="KEYFRAME")
    curves = strip.channelbag(slot, ensure=True).fcurves
    for joint, bone in enumerate(JOINT_NAMES):
        path = f'pose.bones["{bone}"].rotation_quaternion'
        for component in range(4):
            _fill(curves.new(path, index=component), times, quaternions[:, joint, component])
    for axis in range(3):
        _fill(curves.new(f'pose.bones["{JOINT_NAMES[0]}"].location', index=axis), times, location[:, axis])
    for bone in armature.pose.bones:
        bone.rotation_mode = "QUATERNION"
    animation = armature.animation_data_create()
    animation.action = action
    animation.action_slot = slot
    return action


def _fill(curve: bpy.types.FCurve, times: NDArray, values: NDArray) -> None:
    curve.keyframe_points.add(len(times))
    curve.keyframe_points.foreach_set("co", np.stack([times, values], -1).astype(np.float32).ravel())
    curve.keyframe_points.foreach_set("interpolation", np.full(len(times), _LINEAR, np.int32))
    curve.update()
