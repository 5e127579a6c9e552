"""A human in the scene: a marked collection that holds an armature, a body mesh and volumes."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import bpy

from ..formats.regular_files import FileError
from .blend_values import stored_record

PRIMITIVE_VDB = re.compile(r"prim_([0-9]{4,6})\.vdb")
"""File names of the volumes of primitives."""


def primitive_of(volume: bpy.types.Volume) -> int | None:
    """The primitive that a human's volume shows, by the name of its file, wherever that is; None for other volumes."""
    match = PRIMITIVE_VDB.fullmatch(re.split(r"[/\\]", volume.filepath)[-1])
    return int(match[1]) if match is not None else None


def volume_name(k: int) -> str:
    """The file name of a primitive's volume."""
    return f"prim_{k:04d}.vdb"


def write_error(folder: Path, error: BaseException) -> FileError:
    """For errors of the system and of openvdb."""
    reason = getattr(error, "strerror", None) or str(error)
    remedy = "make room there and allow writing"
    return FileError(folder, f"cannot be written to ({reason:.160})", remedy)


MARK = "primdiffusion_human"
"""Custom property of a human's collection: provenance as JSON."""
BODY_MARK = "primdiffusion_body"
"""Custom property of a body mesh: the engine leaves it out, shown or hidden."""
BETAS = "primdiffusion_betas"
"""Custom property of a human's armature: the body's shape, which the engine draws and which may be animated."""
ORIGIN = "primdiffusion_origin"
"""Custom property of a human's bones (the armature's data): the origin of the body model in the armature's space [3],
metres, z up. The armature's own origin is on the floor, at the feet. In humans of earlier versions, which lack the
property, the two are one."""
BETA_COUNT = 10
"""Numbers in a shape."""
LARGEST_BETA = 5.0
"""Beyond this, bodies of linear shape models fall apart."""


def provenance_of(collection: bpy.types.Collection) -> dict[str, Any]:
    """How a human was made: seed, steps, attributes, edits and so on; empty where the .blend holds none.

    The fields are the .blend's, of any type; `generated_betas` checks the shape.
    """
    return stored_record(collection, MARK)


def armature_of(collection: bpy.types.Collection) -> bpy.types.Object:
    """The human's armature. Raises ValueError for a collection that is no human or has lost its armature."""
    for obj in collection.objects:
        if MARK in collection and obj.type == "ARMATURE":
            return obj
    raise ValueError(f"the collection {collection.name!r} holds no generated human; select one that does")


def body_of(collection: bpy.types.Collection) -> bpy.types.Object | None:
    """The human's body mesh; None when it was deleted."""
    return next((obj for obj in collection.all_objects if obj.type == "MESH" and BODY_MARK in obj), None)


def volumes_of(collection: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """The human's volume objects by primitive, whatever the objects are called now."""
    found = defaultdict(list)
    for obj in collection.all_objects:
        primitive = primitive_of(obj.data) if obj.type == "VOLUME" else None
        if primitive is not None:
            found[primitive].append(obj)
    return dict(found)


def humans(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """The humans of a scene."""
    return [collection for collection in scene.collection.children_recursive if MARK in collection]


def any_humans() -> bool:
    """Whether this .blend holds humans, in any scene or in none."""
    return any(MARK in collection for collection in bpy.data.collections)


def human_of(obj: bpy.types.Object | None, scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The human that an object is part of, is parented to (a hat on a bone), or instances; None for other objects."""
    while obj is not None:
        around = set(obj.users_collection)
        for collection in humans(scene):
            if not around.isdisjoint([collection, *collection.children_recursive]):
                return collection
        if obj.instance_collection is not None and MARK in obj.instance_collection:
            return obj.instance_collection
        obj = obj.parent
    return None


def own_data(obj: bpy.types.Object, collection: bpy.types.Collection) -> bpy.types.ID:
    """An object's data, copied first where objects of another human use it too (duplicates share data); all objects of
    this human that use it get the copy."""
    if obj.data.users > 1:
        users = [user for user in bpy.data.user_map(subset=[obj.data])[obj.data] if isinstance(user, bpy.types.Object)]
        inside = set(collection.all_objects).intersection(users)
        if len(inside) < len(users):
            copied = obj.data.copy()
            for user in inside:
                user.data = copied
    return obj.data


def check_editable(collection: bpy.types.Collection) -> None:
    """Raises ValueError for a human that is linked from another .blend, or has lost its armature or all volumes."""
    armature = armature_of(collection)
    parts = [collection, armature, armature.data, *(obj.data for obj in collection.all_objects if obj.data)]
    linked = next((part.library for part in parts if part.library is not None), None)
    if linked is not None:
        raise ValueError(
            f"the human {collection.name!r} is linked from {linked.filepath!r}: edit it there, or make it local with "
            "Object > Relations > Make Local > All"
        )
    if not volumes_of(collection):
        raise ValueError(f"the human {collection.name!r} has no volumes left; generate a human again")


def remove_human(collection: bpy.types.Collection) -> None:
    """Remove a human from the .blend: objects, their data, and actions without other users."""
    objects = list(collection.all_objects)
    data = [obj.data for obj in objects if obj.data is not None]
    held = [value for obj in objects for value in obj.values() if isinstance(value, bpy.types.ID)]
    actions = [obj.animation_data.action for obj in objects if obj.animation_data and obj.animation_data.action]
    bpy.data.batch_remove([*objects, *collection.children_recursive, collection])
    bpy.data.batch_remove([block for block in {*data, *held, *actions} if block.users == 0])
