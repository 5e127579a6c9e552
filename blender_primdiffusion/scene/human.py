"""A human in the scene: an armature that holds its data, with a body mesh, splats and volumes as its children."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..files.regular_files import FileError
from .blend_values import stored_record


def write_error(folder: Path, error: BaseException) -> FileError:
    """For errors of the system and of openvdb."""
    reason = getattr(error, "strerror", None) or str(error)
    remedy = "make room there and allow writing"
    return FileError(folder, f"cannot be written to ({reason:.160})", remedy)


MARK = "primdiffusion_human"
"""Custom property of a human, which is an armature: provenance as JSON."""
BODY_MARK = "primdiffusion_body"
"""Custom property of a body mesh: the engine leaves it out, shown or hidden."""
BETAS = "primdiffusion_betas"
"""Custom property of a human: the body's shape, which the engine draws and which may be animated."""
ORIGIN = "primdiffusion_origin"
"""Custom property of a human's bones (the armature's data): the origin of the body model in the armature's space [3],
metres, z up. The armature's own origin is on the floor, at the feet."""
BETA_COUNT = 10
"""Numbers in a shape."""
LARGEST_BETA = 5.0
"""Beyond this, bodies of linear shape models fall apart."""


def is_human(obj: bpy.types.Object) -> bool:
    """Whether an object is a human: an armature with their mark."""
    return obj.type == "ARMATURE" and MARK in obj


def provenance_of(person: bpy.types.Object) -> dict[str, Any]:
    """How a human was made: seed, steps, attributes, edits and so on; empty where the .blend holds none.

    The fields are the .blend's, of any type; `generated_betas` checks the shape.
    """
    return stored_record(person, MARK)


def parts_of(person: bpy.types.Object) -> list[bpy.types.Object]:
    """The human and all objects below it."""
    return [person, *person.children_recursive]


def body_of(person: bpy.types.Object) -> bpy.types.Object | None:
    """The human's body mesh; None when it was deleted."""
    return next((obj for obj in parts_of(person) if obj.type == "MESH" and BODY_MARK in obj), None)


def humans(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The humans of a scene."""
    return [obj for obj in scene.objects if is_human(obj)]


def all_humans() -> list[bpy.types.Object]:
    """The humans of this .blend, in any scene or in none, linked ones included."""
    return [obj for obj in bpy.data.objects if is_human(obj)]


def any_humans() -> bool:
    """Whether this .blend holds humans."""
    return any(map(is_human, bpy.data.objects))


def human_of(obj: bpy.types.Object | None) -> bpy.types.Object | None:
    """The human that an object is part of, is parented to (a hat on a bone), or instances; None for other objects."""
    while obj is not None:
        if is_human(obj):
            return obj
        instanced = obj.instance_collection.all_objects if obj.instance_collection is not None else ()
        if (inside := next(filter(is_human, instanced), None)) is not None:
            return inside
        obj = obj.parent
    return None


def link_part(person: bpy.types.Object, part: bpy.types.Object) -> None:
    """Put a part, which is in no collection, into the one that the human is in."""
    person.users_collection[0].objects.link(part)


def own_data(obj: bpy.types.Object, person: bpy.types.Object) -> bpy.types.ID:
    """An object's data, copied first where objects of another human use it too (duplicates share data); all objects of
    this human that use it get the copy."""
    if obj.data.users > 1:
        users = [user for user in bpy.data.user_map(subset=[obj.data])[obj.data] if isinstance(user, bpy.types.Object)]
        inside = set(parts_of(person)).intersection(users)
        if len(inside) < len(users):
            copied = obj.data.copy()
            for user in inside:
                user.data = copied
    return obj.data


def check_editable(person: bpy.types.Object) -> None:
    """Raises ValueError for a human that is linked from another .blend."""
    blocks = [person, *(obj.data for obj in parts_of(person) if obj.data)]
    linked = next((block.library for block in blocks if block.library is not None), None)
    if linked is not None:
        raise ValueError(
            f"the human {person.name!r} is linked from {linked.filepath!r}: edit it there, or make it local with "
            "Object > Relations > Make Local > All"
        )
