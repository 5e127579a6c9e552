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
from ..formats.poses.motion import Motion
from ..formats.poses.rotation import nearest
from ..formats.poses.skeleton import unchain
from ..motion.adjust import cut, from_origin, in_place, on_floor, resample, scale_places, stride_ratio
from ..motion.posture import check_posable, rest_joints
from ..scene.actions import last_key, push_to_strip
from ..scene.armature import append_poses, keyframe_poses, model_origin, rest_rotations
from ..scene.blend_values import stored_numbers
from ..scene.convention import BLENDER_FROM_BACKEND, points_to_backend
from ..scene.handles import check_no_handles
from ..scene.human import BETA_COUNT, BETAS
from .on_person import FACTS, scene_fps


@dataclasses.dataclass(frozen=True)
class Placement:
    """How a motion is to be put onto an armature."""

    start: float = 1.0
    """Frame of the first key; ignored for APPEND, which begins a frame after the last key."""
    timing: str = "SCENE"
    """SCENE: a key on every frame of the scene; SOURCE: one for every frame of the motion."""
    first: int = 1
    """Frame of the motion, counted from 1."""
    last: int = 0
    """The same; 0 is the last there is."""
    stride: int = 1
    scale: float = 1.0
    """Factor on the path."""
    fit_stride: bool = True
    """Whether the path is scaled to the armature's legs, before `scale`."""
    root: str = "ORIGIN"
    """ORIGIN: the path begins at the human; KEEP: it stays as in the file; PLACE: the human stays in place."""
    ground: bool = True
    """Whether the whole motion is moved onto the floor."""
    into: str = "NEW"
    """NEW: an action; APPEND: to the one there is; STRIP: a strip of the nonlinear animation."""


def place_motion(
    context: bpy.types.Context, armature: bpy.types.Object, motion: Motion, how: Placement
) -> tuple[float, float]:
    """Set the keys; returns the first and last frame. Raises ValueError before anything is changed."""
    check_posable(armature)
    check_no_handles(armature)
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
    """The motion fitted to a skeleton at rest [24, 3], and its frames in the scene [F], from 0."""
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
    """Facts about a motion for display, label to text."""
    found = motion.detected
    rate = f"{motion.fps:.4g}" + ("" if found.fps else " (assumed)")
    bones = {"Bones": f"{len(found.bones)} of 24"} if found.bones else {}
    people = {"People": f"{len(found.people)}: {', '.join(found.people[:6])}"} if len(found.people) > 1 else {}
    return {
        "Rig": found.rig or "unknown",
        **people,
        **bones,
        "Up Axis": found.up + (" (uncertain)" if found.doubt else ""),
        "Frames": f"{len(motion)} ({len(motion) / motion.fps:.1f} s)",
        "Frame Rate": rate,
        "Units": found.unit,
    }


def extend_range(scene: bpy.types.Scene, last: float) -> None:
    """Extend the scene to the end of the motion."""
    scene.frame_end = max(scene.frame_end, int(np.ceil(last)))


def sample_motion(
    context: bpy.types.Context, armature: bpy.types.Object, first: int, last: int
) -> tuple[Motion, NDArray[np.float64], NDArray[np.float64]]:
    """The motion on frames `first` to `last` in the armature's own space, the shape [n], the rest pelvis [3].

    The object's own transform is left out. Raises ValueError where one of SMPL's joints is missing.
    """
    rest, pelvis = rest_rotations(armature), rest_joints(armature)[0]
    matrices = []
    with _separate_scene(context, armature) as scene:
        for frame in range(first, last + 1):
            scene.frame_set(frame)
            posed = armature.evaluated_get(scene.view_layers[0].depsgraph).pose.bones
            matrices.append([np.array(posed[name].matrix) for name in JOINT_NAMES])
    bones = np.array(matrices, np.float64)
    world = nearest(bones[..., :3, :3]) @ np.swapaxes(rest, -1, -2)
    world = BLENDER_FROM_BACKEND.T @ world @ BLENDER_FROM_BACKEND
    places = points_to_backend(bones[:, 0, :3, 3] - model_origin(armature.data)) - pelvis
    motion = Motion(unchain(world), places, scene_fps(context.scene), armature.name)
    return motion, np.array(stored_numbers(armature, BETAS, BETA_COUNT) or [0.0] * BETA_COUNT), pelvis


@contextmanager
def _separate_scene(context: bpy.types.Context, armature: bpy.types.Object) -> Iterator[bpy.types.Scene]:
    """A scene with nothing but the armature: with a human's thousand volumes a frame takes far longer."""
    scene = bpy.data.scenes.new("sampling")
    render = context.scene.render
    scene.render.fps, scene.render.fps_base = render.fps, render.fps_base
    try:
        scene.collection.objects.link(armature)
        yield scene
    finally:
        bpy.data.scenes.remove(scene)
