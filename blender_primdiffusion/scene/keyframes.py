"""Keyframes for many poses at once: actions of one layer, strip and slot (the same in Blender 4.5 to 5.2)."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from .actions import action_curves, last_key
from .armature import bone_bases, rest_rotations
from .convention import continuous_quaternions

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
    action = bpy.data.actions.new(name)
    slot = action.slots.new(id_type="OBJECT", name=armature.name)
    strip = action.layers.new("Pose").strips.new(type="KEYFRAME")
    curves = strip.channelbag(slot, ensure=True).fcurves
    for (path, index), values in channels.items():
        _add(curves.new(path, index=index), frames, values)
    _use_quaternions(armature)
    animation = armature.animation_data_create()
    animation.action = action
    animation.action_slot = slot
    return action


def append_poses(armature: bpy.types.Object, frames: NDArray, rotations: NDArray, translations: NDArray) -> None:
    """Append keys to the armature's action; arguments and errors as for `keyframe_poses`.

    Also raises ValueError where the armature has no action, or one that is linked or has keys at or after the first of
    `frames`.
    """
    channels = _channels(armature, frames, rotations, translations)
    curves = action_curves(armature)
    action = armature.animation_data.action if armature.animation_data else None
    if action is None or curves is None:
        raise ValueError(f"{armature.name!r} has no motion to append to: import it as a new action")
    if action.library is not None:
        raise ValueError(f"the action {action.name!r} is linked from another file: import into a new action")
    end = last_key(armature)
    if end >= frames[0]:
        raise ValueError(f"the action {action.name!r} goes on until frame {end:g}: start later than that")
    existing = {(curve.data_path, curve.array_index): curve for curve in curves}
    for bone in JOINT_NAMES:
        path = f'pose.bones["{bone}"].rotation_quaternion'
        keys = [(path, component) for component in range(4)]
        last = [existing[key].keyframe_points[-1].co[1] if key in existing else float(key[1] == 0) for key in keys]
        if sum(value * channels[key][0] for key, value in zip(keys, last, strict=True)) < 0:
            for key in keys:  # q and -q are the same rotation, but Blender interpolates components
                channels[key] = -channels[key]
    for key, values in channels.items():
        _add(existing[key] if key in existing else curves.new(key[0], index=key[1]), frames, values)
    _use_quaternions(armature)


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


def _add(curve: bpy.types.FCurve, times: NDArray, values: NDArray) -> None:
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
