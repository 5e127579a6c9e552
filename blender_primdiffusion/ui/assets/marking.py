"""What makes a person or a pose an asset: mark, words to find it by, picture."""

from __future__ import annotations

import json
from collections.abc import Iterable

import bpy
import numpy as np
from numpy.typing import NDArray

from ...scene.human import MARK
from ...scene.keyframes import keyframe_poses
from .thumbnails import show

POSE_TAG, HUMAN_TAG = "pose", "human"


def mark(asset: bpy.types.ID, description: str, tags: Iterable[str], picture: NDArray) -> None:
    """Make a data-block an asset, or renew what it is told of. Raises ValueError for one that is linked."""
    if asset.library is not None:
        raise ValueError(f"{asset.name!r} is linked from {asset.library.filepath!r}: mark it as an asset there")
    asset.asset_mark()
    about = asset.asset_data
    about.description = description
    for tag in tags:
        about.tags.new(tag, skip_if_exists=True)
    show(asset, picture)


def human_words(person: bpy.types.Collection) -> tuple[str, list[str]]:
    """Description and tags of a person: their seed, and what they were asked to be."""
    try:
        made = json.loads(person[MARK])
    except (ValueError, TypeError):
        made = {}
    asked = made.get("attributes") or {}
    said = ", ".join(f"{name} {value}" for name, value in asked.items())
    seed = f"seed {made['seed']}" if "seed" in made else "no seed"
    description = f"Generated person, {seed}" + (f", asked to be: {said}" if said else "")
    return description, [HUMAN_TAG, *(str(value) for value in asked.values() if isinstance(value, str))]


def pose_action(armature: bpy.types.Object, rotations: NDArray, translation: NDArray, name: str) -> bpy.types.Action:
    """A pose as Blender's pose library wants it: an action with one key of every bone, at frame 1.

    The armature keeps the action it has. Rotations [24, 3, 3] and translation [3] as for `keyframe_poses`.
    """
    had = armature.animation_data is not None
    animation = armature.animation_data_create()
    action, slot = animation.action, animation.action_slot
    try:
        made = keyframe_poses(armature, np.ones(1), rotations[None], translation[None], name)
    finally:
        animation.action = action
        if action is not None:
            animation.action_slot = slot
        if not had:
            armature.animation_data_clear()
    return made
