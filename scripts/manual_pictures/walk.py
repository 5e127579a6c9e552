"""Three people walk side by side, for ever: the floor runs below them, a stride a round."""

from __future__ import annotations

from pathlib import Path

import bpy

from blender_primdiffusion.motion.walk import CYCLE_SECONDS, STRIDE

from .shrink import save_gif
from .stage import armature_of, empty_file, generate, look, render, tiled_floor

SEEDS = (3, 53, 23)
FRAMES = 32
"""Of a round."""
FPS = 30
SIZE = (480, 400)
_APART = 0.82
_OUT_OF_STEP = 11
"""Frames by which each is behind the one before."""


def walk(scratch: Path, out: Path) -> None:
    """Generate, add the built-in motion, render a round with the engine, save the loop."""
    scene = empty_file(scratch / "walk.blend")
    scene.render.fps = FPS
    middle = (len(SEEDS) - 1) / 2
    for number, seed in enumerate(SEEDS):
        person = generate(seed, ((number - middle) * _APART, abs(number - middle) * 0.35))
        bpy.context.view_layer.objects.active = armature_of(person)
        bpy.ops.primdiffusion.add_motion(
            motion="WALK", rounds=4, speed=CYCLE_SECONDS * FPS / FRAMES, root="PLACE", start=1 - number * _OUT_OF_STEP
        )
    floor = tiled_floor(scene, STRIDE / 2)
    look(scene, (-2.2, -5.6, 1.5), (0.06, 0.1, 0.87), 82)
    pictures = []
    for frame in range(FRAMES):
        scene.frame_set(1 + FRAMES + frame)
        floor.location.y = STRIDE * frame / FRAMES
        pictures.append(render(scene, scratch / f"{frame:04d}.png", SIZE))
    save_gif(pictures, out, 1000 // FPS)
