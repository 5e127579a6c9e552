"""Motions put onto armatures, fitted to their legs and the scene's rate, and read back from them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..motion.adjust import cut, from_origin, in_place, on_floor, resample, scale_places, stride_ratio
from ..motion.motion import Motion
from ..motion.pose_library import check_posable, rest_joints
from ..motion.rotation import nearest
from ..motion.skeleton import unchain
from ..scene.actions import last_key, push_to_strip
from ..scene.armature import rest_rotations
from ..scene.convention import BLENDER_FROM_BACKEND, points_to_backend
from ..scene.human import BETAS
from ..scene.keyframes import append_poses, keyframe_poses
from .motion_armatures import FACTS, scene_fps


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


def sample_motion(
    context: bpy.types.Context, armature: bpy.types.Object, first: int, last: int
) -> tuple[Motion, NDArray[np.float64], NDArray[np.float64]]:
    """The motion on frames `first` to `last` in the armature's own space, the shape [n], the rest pelvis [3].

    Where the object itself is moved or scaled does not count. Raises ValueError where one of SMPL's joints lacks.
    """
    rest, pelvis = rest_rotations(armature), rest_joints(armature)[0]
    matrices = []
    with _scene_of_its_own(context, armature) as scene:
        for frame in range(first, last + 1):
            scene.frame_set(frame)
            posed = armature.evaluated_get(scene.view_layers[0].depsgraph).pose.bones
            matrices.append([np.array(posed[name].matrix) for name in JOINT_NAMES])
    bones = np.array(matrices, np.float64)
    world = nearest(bones[..., :3, :3]) @ np.swapaxes(rest, -1, -2)
    world = BLENDER_FROM_BACKEND.T @ world @ BLENDER_FROM_BACKEND
    places = points_to_backend(bones[:, 0, :3, 3]) - pelvis
    motion = Motion(unchain(world), places, scene_fps(context.scene), armature.name)
    return motion, np.asarray(list(armature.get(BETAS, np.zeros(10))), np.float64), pelvis


@contextmanager
def _scene_of_its_own(context: bpy.types.Context, armature: bpy.types.Object) -> Iterator[bpy.types.Scene]:
    """A scene with nothing but the armature: a frame of a person's takes as long as a thousand volumes."""
    scene = bpy.data.scenes.new("sampling")
    render = context.scene.render
    scene.render.fps, scene.render.fps_base = render.fps, render.fps_base
    try:
        scene.collection.objects.link(armature)
        yield scene
    finally:
        bpy.data.scenes.remove(scene)
