"""Humans in background mode: built in a file, posed or moved, in front of a camera."""

from __future__ import annotations

import argparse
import dataclasses
import math
from pathlib import Path

import bpy
import numpy as np

from ...engine.engine import ENGINE
from ...formats.poses.files import read_motion
from ...formats.poses.motion import Motion
from ...formats.regular_files import remove_file
from ...scene.armature import keyframe_poses, pose_from_joint_rotations
from ...scene.build import build_human
from ...scene.cycles import frame_box, framing_distance, humans_extent, setup_cycles_preview
from ...scene.human import humans

_SAMPLED = 24
"""Frames of a motion that determine the distance of the camera."""


@dataclasses.dataclass(frozen=True)
class Movement:
    """What all humans do: a pose of one frame, or a motion."""

    motion: Motion
    still: bool

    def apply(self, context: bpy.types.Context, person: bpy.types.Object) -> None:
        """Pose the human, or key a motion from frame 1 on and set the scene to its length and rate."""
        motion = self.motion
        if self.still:
            pose_from_joint_rotations(person, motion.rotations[0], np.zeros(3))
            return
        keyframe_poses(person, 1 + np.arange(len(motion)), motion.rotations, motion.translations, motion.name)
        scene = context.scene
        scene.frame_start, scene.frame_end = 1, len(motion)
        scene.render.fps, scene.render.fps_base = max(1, round(motion.fps)), max(1, round(motion.fps)) / motion.fps
        scene.frame_set(1)


def movement_of(options: argparse.Namespace) -> Movement | None:
    """What --pose or --motion names. Raises FileError."""
    path = options.pose or options.motion
    return None if path is None else Movement(read_motion(path), options.pose is not None)


def person_blend(person: Path, blend: Path, name: str, movement: Movement | None) -> None:
    """Save a .blend with one human, ready to render. Replaces the open file.

    Raises as `build_human`, OSError.
    """
    new_file()
    build_person(bpy.context, person, name, movement)
    _save(blend)
    remove_file(blend.with_name(f"{blend.name}1"), blend.parent)  # Blender's backup


def new_file() -> None:
    """Open an empty file; preferences and add-ons stay."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


def build_person(context: bpy.types.Context, person: Path, name: str, movement: Movement | None) -> bpy.types.Object:
    """Build the human of a file in the open file, moved, with a camera and a transparent background."""
    person = build_human(context, person, name)
    if movement is not None:
        movement.apply(context, person)
    scene = context.scene
    setup_cycles_preview(scene, size=512, samples=4)
    scene.render.engine = ENGINE
    frame_box(scene.camera, moving_extent(scene), 0.0)
    return person


def moving_extent(scene: bpy.types.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box that contains all humans over the scene's frames, of which some are sampled."""
    if not any(person.animation_data for person in humans(scene)):
        return humans_extent(scene)
    before, lows, highs = scene.frame_current, [], []
    for frame in np.unique(np.linspace(scene.frame_start, scene.frame_end, _SAMPLED).round().astype(int)):
        scene.frame_set(int(frame))
        low, high = humans_extent(scene)
        lows.append(low)
        highs.append(high)
    scene.frame_set(before)
    return np.min(lows, 0), np.max(highs, 0)


def look_from(scene: bpy.types.Scene, degrees: float, extent: tuple[np.ndarray, np.ndarray]) -> None:
    """Move the scene's camera to `degrees` from the front towards the humans' left, as near as shows all of them."""
    frame_box(scene.camera, extent, math.radians(degrees), _size(scene))


def go_round(scene: bpy.types.Scene, degrees: float, extent: tuple[np.ndarray, np.ndarray]) -> None:
    """As `look_from`, from the same distance on all sides."""
    camera, size = scene.camera, _size(scene)
    farthest = max(framing_distance(camera, extent, yaw, size) for yaw in np.linspace(0, 2 * math.pi, 72))
    frame_box(camera, extent, math.radians(degrees), size, farthest)


def _size(scene: bpy.types.Scene) -> tuple[int, int]:
    return scene.render.resolution_x, scene.render.resolution_y


def _save(blend: Path) -> None:
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(blend), check_existing=False)
    except RuntimeError as error:
        raise OSError(f"{blend} could not be written: {error}") from error
