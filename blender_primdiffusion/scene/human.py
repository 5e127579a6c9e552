"""A human in the scene: a marked collection that holds an armature, a body mesh and volumes.

Panels import this file when Blender starts, so it needs no numpy.
"""

from __future__ import annotations

from collections import defaultdict

import bpy

from .files import PRIMITIVE_VDB, volume_path

MARK = "primdiffusion_human"
"""Custom property of a human's collection: provenance as JSON."""
BODY_MARK = "primdiffusion_body"
"""Custom property of a body mesh: the engine leaves it out, shown or hidden."""
BETAS = "primdiffusion_betas"
"""Custom property of a human's armature: the body's shape, which the engine draws and which may be animated."""
BETA_COUNT = 10
"""Numbers in a shape."""
LARGEST_BETA = 5.0
"""Beyond this, bodies of linear shape models fall apart."""


def armature_of(collection: bpy.types.Collection) -> bpy.types.Object:
    """The human's armature. Raises ValueError for a collection that is no human or has lost its armature."""
    for obj in collection.objects:
        if MARK in collection and obj.type == "ARMATURE":
            return obj
    raise ValueError(f"the collection {collection.name!r} holds no generated person; select one that does")


def body_of(collection: bpy.types.Collection) -> bpy.types.Object | None:
    """The human's body mesh; None when it was deleted."""
    return next((obj for obj in collection.all_objects if obj.type == "MESH" and BODY_MARK in obj), None)


def volumes_of(collection: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """The human's volume objects by primitive, which the file name gives whatever the object is called now."""
    found = defaultdict(list)
    for obj in collection.all_objects:
        if obj.type == "VOLUME" and (match := PRIMITIVE_VDB.fullmatch(volume_path(obj.data).name)):
            found[int(match[1])].append(obj)
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
    """An object's data, copied first where objects of another human use it too (duplicates share data)."""
    if obj.data.users > 1:
        users = bpy.data.user_map(subset=[obj.data])[obj.data]
        if any(isinstance(user, bpy.types.Object) and user not in set(collection.all_objects) for user in users):
            obj.data = obj.data.copy()
    return obj.data


def check_editable(collection: bpy.types.Collection) -> None:
    """Raises ValueError for a human that is linked from another .blend, or has lost its armature or all volumes."""
    armature = armature_of(collection)
    parts = [collection, armature, armature.data, *(obj.data for obj in collection.all_objects if obj.data)]
    linked = next((part.library for part in parts if part.library is not None), None)
    if linked is not None:
        raise ValueError(
            f"the person {collection.name!r} is linked from {linked.filepath!r}: edit it there, or make it local with "
            "Object > Relations > Make Local > All"
        )
    if not volumes_of(collection):
        raise ValueError(f"the person {collection.name!r} has no volumes left; generate a person again")


def remove_human(collection: bpy.types.Collection) -> None:
    """Remove a human from the .blend: objects, their data, and actions without other users.

    The VDB files stay for undo, and for older copies of the .blend.
    """
    objects = list(collection.all_objects)
    data = [obj.data for obj in objects if obj.data is not None]
    actions = [obj.animation_data.action for obj in objects if obj.animation_data and obj.animation_data.action]
    bpy.data.batch_remove([*objects, *collection.children_recursive, collection])
    bpy.data.batch_remove([block for block in {*data, *actions} if block.users == 0])
