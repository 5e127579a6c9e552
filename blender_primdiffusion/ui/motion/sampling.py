"""The motion an armature makes, constraints and nonlinear animation included, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np
from numpy.typing import NDArray

from ...formats.joints import JOINT_NAMES
from ...motion.motion import Motion
from ...motion.pose_library import rest_joints
from ...motion.rotation import nearest
from ...motion.skeleton import unchain
from ...scene.armature import rest_rotations
from ...scene.convention import BLENDER_FROM_BACKEND, points_to_backend
from ...scene.human import BETAS
from .armatures import scene_fps


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
