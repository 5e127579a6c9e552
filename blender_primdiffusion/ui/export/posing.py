"""People in their poses, in the world, as the child's methods take them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import bpy
import numpy as np

from ...engine.people import posed
from ...scene.export_model import check_ready, scene_with_only
from ...scene.human import armature_of


def posed_now(context: bpy.types.Context, person: bpy.types.Collection) -> dict[str, Any]:
    """The person at the current frame (see `posed_frames`)."""
    return posed_frames(context, person, [context.scene.frame_current])[0]


def posed_frames(
    context: bpy.types.Context, person: bpy.types.Collection, frames: Iterable[int]
) -> list[dict[str, Any]]:
    """The person at these frames: file, the object's place, joints and shape, as of the child's draw.

    Raises ValueError for an armature in Edit Mode or without SMPL's bones, FileNotFoundError where the file is missing.
    """
    armature = armature_of(person)
    check_ready(armature)
    found = []
    with scene_with_only(context, armature) as scene:
        for frame in frames:
            if frame != scene.frame_current:
                scene.frame_set(frame)
            evaluated = armature.evaluated_get(scene.view_layers[0].depsgraph)
            found.append(posed(evaluated, np.array(evaluated.matrix_world, np.float64), person).params())
    return found
