"""Many poses at once as keyframes: actions of one layer, strip and slot (the same in Blender 4.5 to 5.2)."""

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
    """A new action on the armature: SMPL joint rotations [F, 24, 3, 3] and translations [F, 3] (y up, metres) at
    `frames` [F].

    Frames may be fractional and must increase. Keys are linear, so that motion sampled every frame is met exactly;
    between keys quaternions are interpolated by component. Raises ValueError when the lengths differ or frames do not
    increase.
    """
    channels = _channels(armature, frames, rotations, translations)
    action = bpy.data.actions.new(name)
    slot = action.slots.new(id_type="OBJECT", name=armature.name)
    strip = action.layers.new("Pose").strips.new(type="KEYFRAME")
    curves = strip.channelbag(slot, ensure=True).fcurves
    for (path, index), values in channels.items():
        _add(curves.new(path, index=index), frames, values)
    _quaternions_everywhere(armature)
    animation = armature.animation_data_create()
    animation.action = action
    animation.action_slot = slot
    return action


def append_poses(armature: bpy.types.Object, frames: NDArray, rotations: NDArray, translations: NDArray) -> None:
    """More keys at the end of the action the armature has; arguments and errors as for `keyframe_poses`.

    Raises ValueError too where the armature has no action, one that is linked, or one with keys at or after the first
    of `frames`.
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
    had = {(curve.data_path, curve.array_index): curve for curve in curves}
    for bone in JOINT_NAMES:
        path = f'pose.bones["{bone}"].rotation_quaternion'
        ends = [had[path, i].keyframe_points[-1].co[1] if (path, i) in had else float(i == 0) for i in range(4)]
        if sum(end * channels[path, i][0] for i, end in enumerate(ends)) < 0:  # q and -q turn alike, components do not
            for i in range(4):
                channels[path, i] = -channels[path, i]
    for key, values in channels.items():
        _add(had[key] if key in had else curves.new(key[0], index=key[1]), frames, values)
    _quaternions_everywhere(armature)


def _channels(
    armature: bpy.types.Object, frames: NDArray, rotations: NDArray, translations: NDArray
) -> dict[tuple[str, int], NDArray[np.float64]]:
    """Values [F] by the path and index of a curve. Raises ValueError as `keyframe_poses`."""
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
    channels = {
        (f'pose.bones["{bone}"].rotation_quaternion', component): quaternions[:, joint, component]
        for joint, bone in enumerate(JOINT_NAMES)
        for component in range(4)
    }
    path = f'pose.bones["{JOINT_NAMES[0]}"].location'
    return channels | {(path, axis): location[:, axis] for axis in range(3)}


def _quaternions_everywhere(armature: bpy.types.Object) -> None:
    for name in JOINT_NAMES:
        armature.pose.bones[name].rotation_mode = "QUATERNION"


def _add(curve: bpy.types.FCurve, times: NDArray, values: NDArray) -> None:
    """Linear keys after those that the curve has."""
    points = curve.keyframe_points
    had = len(points)
    points.add(len(times))
    places, kinds = np.empty(2 * len(points), np.float32), np.empty(len(points), np.int32)
    points.foreach_get("co", places)
    points.foreach_get("interpolation", kinds)
    places[2 * had :] = np.stack([times, values], -1).ravel()
    kinds[had:] = _LINEAR
    points.foreach_set("co", places)
    points.foreach_set("interpolation", kinds)
    curve.update()
