"""Edits of humans in the scene, written and shown at once."""

from __future__ import annotations

from pathlib import Path

import bpy

from blender_primdiffusion.scene.edit import Replaced, edit_destination, replace_person
from blender_primdiffusion.scene.human_npz import write_now


def replace(collection: bpy.types.Collection, human_npz: Path, person: Path) -> Replaced:
    return replace_person(collection, write_now(human_npz, edit_destination(collection)), person)
