"""Three people walk side by side in an endless loop; the floor below each moves by one of their strides per loop."""

from __future__ import annotations

import math
from pathlib import Path

import bpy

from blender_primdiffusion.motion.placing import leg_ratio
from blender_primdiffusion.motion.poses import rest_joints

from ..bake_poses.motions import CYCLE_SECONDS, STRIDE
from .shrink import save_gif
from .stage import empty_file, generate, look, render, tiled_floor

SEEDS = (17, 22, 26)
FRAMES = 32
"""Frames per loop."""
FPS = 30
SIZE = (480, 400)
_APART = 0.82
_WIDEST = 40
"""Columns of tiles of the floors at the sides; the one in the middle has two."""
_OUT_OF_STEP = 11
"""Frames by which each person lags behind the previous one."""


def walk(scratch: Path, out: Path) -> None:
    """Generate, add the built-in motion, render one loop with the engine, save it."""
    scene = empty_file(scratch / "walk.blend")
    scene.render.fps = FPS
    middle, floors = (len(SEEDS) - 1) / 2, []
    for number, seed in enumerate(SEEDS):
        person = generate(seed, ((number - middle) * _APART, abs(number - middle) * 0.35))
        armature = person
        floors.append(_floor(scene, number - middle, STRIDE * leg_ratio(rest_joints(armature))))
        bpy.context.view_layer.objects.active = armature
        bpy.ops.primdiffusion.add_motion(
            motion="WALK", rounds=4, speed=CYCLE_SECONDS * FPS / FRAMES, root="PLACE", start=1 - number * _OUT_OF_STEP
        )
    look(scene, (-2.2, -5.6, 1.5), (0.06, 0.1, 0.87), 82)
    pictures = []
    for frame in range(FRAMES):
        scene.frame_set(1 + FRAMES + frame)
        for floor, stride in floors:
            floor.location.y = stride * frame / FRAMES
        pictures.append(render(scene, scratch / f"{frame:04d}.png", SIZE))
    save_gif(pictures, out, 1000 // FPS, colours=176)


def _floor(scene: bpy.types.Scene, lane: float, stride: float) -> tuple[bpy.types.Object, float]:
    """A floor for one person, two tiles wide and extended to their side; and their stride in metres."""
    columns = _WIDEST if lane else 2
    floor = tiled_floor(scene, stride / 2, columns)
    floor.scale.x = _APART / stride
    floor.location.x = math.copysign((columns / 2 - 1) * _APART / 2, lane) + lane * _APART
    return floor, stride
