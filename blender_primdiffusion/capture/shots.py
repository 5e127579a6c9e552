"""One view of the stage, rendered."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..formats.camera_rig import View
from .blender_camera import aim
from .passes import Centres, Colours, read_centres, read_colours
from .stage import Stage, StageError

_NARROWEST_PX = 0.01
"""Cycles' narrowest filter: rays leave within 0.02 px of the pixel's centre."""


def shoot_colours(stage: Stage, view: View, seed: int, samples: int) -> Colours:
    """Colours and coverage, averaged over each pixel by a box of its size. Raises StageError."""
    cycles = stage.scene.cycles
    cycles.pixel_filter_type, cycles.samples = "BOX", samples
    return read_colours(_render(stage, view, seed))


def shoot_centres(stage: Stage, view: View, seed: int) -> Centres:
    """What is behind the pixels' centres, by one ray each. Raises StageError."""
    cycles = stage.scene.cycles
    denoise, cycles.use_denoising = cycles.use_denoising, False
    cycles.pixel_filter_type, cycles.filter_width, cycles.samples = "GAUSSIAN", _NARROWEST_PX, 1
    try:
        return read_centres(_render(stage, view, seed))
    finally:
        cycles.use_denoising = denoise


def _render(stage: Stage, view: View, seed: int) -> Path:
    scene, render, path = stage.scene, stage.scene.render, stage.scratch / "view.exr"
    render.resolution_x, render.resolution_y = view.width, view.height
    render.pixel_aspect_x, render.pixel_aspect_y = aim(stage.camera, view)
    scene.cycles.seed = seed
    path.unlink(missing_ok=True)
    try:
        with stage.belongings:  # the first render makes the image Render Result
            bpy.ops.render.render(scene=scene.name)
        render.pixel_aspect_x = render.pixel_aspect_y = 1.0  # 5.0 cannot write layers of pixels that are no squares
        result = next(image for image in bpy.data.images if image.type == "RENDER_RESULT")
        result.save_render(str(path), scene=scene)
    except RuntimeError as error:
        raise StageError(f"Cycles could not render: {' '.join(str(error).split())}") from error
    if not path.is_file():
        raise StageError(f"Cycles wrote no picture to {stage.scratch}: is there room, and is the folder writable?")
    return path
