"""The selected person as a .human file."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ...motion.skeleton import unchain
from ...scene.export_model import FrameRange
from ...scene.files import person_file
from ...scene.human_file import HumanMotion, read_tensors, reshaped, with_motion, write_tensors
from ...scene.shape import BODY_FILE, betas_of, generated_betas, has_custom_shape, shape_model_of
from .posing import posed_frames


def write_human(
    context: bpy.types.Context, person: bpy.types.Collection, path: Path, frames: FrameRange | None
) -> None:
    """Writes the person with the shape they have now, and their motion on `frames`. Raises ValueError or OSError.

    The motion is that of the joints in the armature's space, constraints and layers included; where the object stands
    is left out.
    """
    human = read_tensors(person_file(person))
    if has_custom_shape(person):
        betas, growth = betas_of(person), None
        if BODY_FILE in person:  # people of earlier versions have none, and boxes that keep their size
            growth = shape_model_of(person).growth(generated_betas(person), betas)
        human = reshaped(human, betas, growth)
    motion = None if frames is None else _motion(context, person, frames)
    write_tensors(path, with_motion(human, motion))


def _motion(context: bpy.types.Context, person: bpy.types.Collection, frames: FrameRange) -> HumanMotion:
    from ...scene.convention import points_to_backend
    from ...scene.human import armature_of

    numbers = range(frames.first, frames.last + 1)
    joints = np.array([entry["joints"] for entry in posed_frames(context, person, numbers)], np.float64)
    pelvis = points_to_backend(np.array(armature_of(person).data.bones["pelvis"].head_local))
    left, _, right = np.linalg.svd(joints[..., :3])
    rotations = left @ right  # the nearest rotations: bones may be scaled
    translations = joints[:, 0, :, :3] @ pelvis + joints[:, 0, :, 3] - pelvis
    render = context.scene.render
    return HumanMotion(
        np.array(numbers, np.float32),
        unchain(rotations).astype(np.float32),
        translations.astype(np.float32),
        render.fps / render.fps_base,
    )
