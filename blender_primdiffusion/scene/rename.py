"""People by another name: the collection and all of its parts that are still called after it."""

from __future__ import annotations

import contextlib

import bpy

from .human import armature_of
from .surface import build_surface, carrier_of

LONGEST = 40
"""Characters; parts of people add to it, and Blender's names end at 63."""


def rename_human(collection: bpy.types.Collection, name: str) -> None:
    """Call a person `name`, and their armature, body mesh and volumes after it; files on disk keep their names.

    Parts that somebody has renamed keep their names. Blender adds a number where the name is taken. Raises ValueError
    for an empty name and for a person who is linked.
    """
    armature = armature_of(collection)
    name = name.strip()[:LONGEST]
    if not name:
        raise ValueError(f"the person {collection.name!r} needs a name: type one")
    linked = next((thing.library for thing in (collection, armature) if thing.library is not None), None)
    if linked is not None:
        raise ValueError(f"the person {collection.name!r} is linked from {linked.filepath!r}: rename them there")
    before = collection.name
    collection.name = name
    parts = [*collection.children_recursive, *collection.all_objects]
    shared = {thing.data for thing in collection.all_objects if thing.data is not None}
    for part in [*parts, *shared]:
        new = part_name(part.name, before, collection.name)
        if part.library is None and new != part.name:
            part.name = new
    keep_surface(collection)


def part_name(name: str, before: str, after: str) -> str:
    """What a part is called once the person who was `before` is `after`."""
    if name == before or name.startswith(f"{before}_"):
        return after + name[len(before) :]
    return name


def keep_surface(collection: bpy.types.Collection) -> None:
    """Have a person attached to their surface show the same volumes after names have changed: its nodes sort by name.

    Where the body mesh or the body's file is gone nothing can be kept, and nothing is shown there either.
    """
    if carrier_of(collection) is not None:
        with contextlib.suppress(ValueError, FileNotFoundError):
            build_surface(collection)
