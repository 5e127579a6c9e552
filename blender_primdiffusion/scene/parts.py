"""The parts of a human follow the armature: Blender's own operators delete and copy what is selected, of a human the
armature alone."""

from __future__ import annotations

import bpy

from .build import build_missing_parts
from .human import BODY_MARK, PROXY_MARK, all_humans
from .merged import MARK as MERGED_MARK
from .splats import CELLS_MARK, SPLATS_AVAILABLE, SPLATS_MARK, cloud_of
from .stand_in import STAND_IN
from .volume_nodes import VOLUMES_MARK, volumes_of

_MARKS = (BODY_MARK, PROXY_MARK, VOLUMES_MARK, STAND_IN, MERGED_MARK, SPLATS_MARK, CELLS_MARK)
"""Custom properties of parts."""


def orphans() -> list[bpy.types.Object]:
    """Parts of this .blend whose armature was deleted."""
    parts = (obj for obj in bpy.data.objects if any(mark in obj for mark in _MARKS))
    return [part for part in parts if part.parent is None and _is_local(part)]


def without_parts() -> list[bpy.types.Object]:
    """Humans of this .blend that lack splats and volumes: copies of an armature alone."""
    here = (person for person in all_humans() if _is_local(person) and person.users_scene)
    return [one for one in here if volumes_of(one) is None and not (SPLATS_AVAILABLE and cloud_of(one))]


def complete_humans() -> bool:
    """Remove parts without an armature, and give humans without parts their own; whether anything has changed.

    Makes no undo step. Raises as `build_missing_parts`.
    """
    lost, bare = orphans(), without_parts()
    if not (
        lost or bare
    ):  # even of nothing, batch_remove remakes view layers, which crashes a render that begins (5.3)
        return False
    data = {obj.data for obj in lost if obj.data is not None}
    around = {
        collection for obj in lost for collection in obj.users_collection if collection in set(bpy.data.collections)
    }
    bpy.data.batch_remove(lost)
    bpy.data.batch_remove([block for block in data if block.users == 0])
    while empty := [one for one in around if not one.all_objects]:
        around.difference_update(empty)
        bpy.data.batch_remove(empty)
    for person in bare:
        build_missing_parts(person)
    return True


def _is_local(obj: bpy.types.Object) -> bool:
    return obj.library is None and obj.override_library is None
