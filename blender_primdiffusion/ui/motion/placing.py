"""A motion onto an armature: fitted to its legs and the scene's rate; a new action, an old one or a strip."""

from __future__ import annotations

import dataclasses
import json

import bpy
import numpy as np
from numpy.typing import NDArray

from ...motion.adjust import cut, from_origin, in_place, on_floor, resample, scale_places
from ...motion.motion import Motion
from ...motion.pose_library import check_posable, rest_joints
from ...motion.stride import stride_ratio
from ...scene.actions import last_key, push_to_strip
from ...scene.keyframes import append_poses, keyframe_poses
from .armatures import scene_fps
from .settings import FACTS


@dataclasses.dataclass(frozen=True)
class Placement:
    """How a motion is to be put onto an armature."""

    start: float = 1.0
    """Frame of the first key; what is appended comes a frame after the last key instead."""
    timing: str = "SCENE"
    """SCENE: a key on every frame of the scene; SOURCE: one for every frame of the motion."""
    first: int = 1
    """Frame of the motion, counted from 1."""
    last: int = 0
    """The same; 0 is the last there is."""
    stride: int = 1
    scale: float = 1.0
    """Of the path."""
    fit_stride: bool = True
    """Whether the path is made as long as the armature's legs go, before `scale`."""
    root: str = "ORIGIN"
    """ORIGIN: the path begins at the person; KEEP: it is left alone; PLACE: they stay where they are."""
    ground: bool = True
    """Whether the whole motion is raised or lowered onto the floor."""
    into: str = "NEW"
    """NEW: an action; APPEND: to the one there is; STRIP: a strip of the nonlinear animation."""


def place_motion(
    context: bpy.types.Context, armature: bpy.types.Object, motion: Motion, how: Placement
) -> tuple[float, float]:
    """Put the keys in; returns the first and last frame. Raises ValueError before anything is changed."""
    check_posable(armature)
    rest = rest_joints(armature)
    ratio = stride_ratio(motion, rest) if how.fit_stride else None
    way = dataclasses.replace(how, scale=how.scale * (1.0 if ratio is None else ratio))
    fitted, times = fit(motion, rest, scene_fps(context.scene), way)
    start = how.start
    if how.into == "APPEND":
        end = last_key(armature)
        start = end + 1.0 if np.isfinite(end) else how.start
    frames = start + times
    if how.into == "APPEND":
        append_poses(armature, frames, fitted.rotations, fitted.translations)
        action = armature.animation_data.action
    else:
        action = keyframe_poses(armature, frames, fitted.rotations, fitted.translations, motion.name)
        action.use_fake_user = True
    action[FACTS] = json.dumps({**facts(motion), "Stride": "as in the file" if ratio is None else f"x {ratio:.2f}"})
    if how.into == "STRIP":
        push_to_strip(armature)
    return float(frames[0]), float(frames[-1])


def fit(motion: Motion, rest: NDArray, scene_rate: float, how: Placement) -> tuple[Motion, NDArray[np.float64]]:
    """The motion as it is to be keyed on a skeleton at rest [24, 3], and frames of the scene [F] from 0."""
    fitted = cut(motion, how.first, how.last, how.stride)
    if how.timing == "SCENE":
        fitted = resample(fitted, scene_rate)
    fitted = scale_places(fitted, how.scale)
    if how.root != "KEEP":
        fitted = in_place(fitted) if how.root == "PLACE" else from_origin(fitted)
    if how.ground:
        fitted = on_floor(fitted, rest)
    return fitted, np.arange(len(fitted)) * (scene_rate / fitted.fps)


def facts(motion: Motion) -> dict[str, str]:
    """What people want to know of a motion, label to text."""
    found = motion.detected
    told = f"{motion.fps:.4g}" + ("" if found.fps else " (assumed)")
    bones = {"Bones": f"{len(found.bones)} of 24"} if found.bones else {}
    return {
        "Rig": found.rig or "unknown",
        **bones,
        "Up Axis": found.up or "not found, y assumed",
        "Frames": f"{len(motion)} ({len(motion) / motion.fps:.1f} s)",
        "Frame Rate": told,
        "Units": found.unit,
    }


def extend_range(scene: bpy.types.Scene, last: float) -> None:
    """The scene ends no earlier than the motion."""
    scene.frame_end = max(scene.frame_end, int(np.ceil(last)))
