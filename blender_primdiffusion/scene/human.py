"""A human in the scene: a marked collection that holds an armature, a body mesh and volumes."""

from __future__ import annotations

from collections import defaultdict

import bpy

from .files import PRIMITIVE_VDB, volume_path

MARK = "primdiffusion_human"
"""Custom property of a person's collection: its provenance as JSON."""
BETAS = "primdiffusion_betas"
"""Custom property of a person's armature: the body's shape, which the engine draws and which may be animated."""
BETA_COUNT = 10
"""Numbers in a shape."""
LARGEST_BETA = 5.0
"""Beyond, bodies of linear shape models fall apart."""
BODY_MARK = "primdiffusion_body"
"""Custom property of a body mesh: the engine leaves it out, shown or hidden."""


def armature_of(collection: bpy.types.Collection) -> bpy.types.Object:
    """The person's armature object; ValueError when the collection is no person or lost it."""
    for candidate in collection.objects:
        if MARK in collection and candidate.type == "ARMATURE":
            return candidate
    raise ValueError(f"the collection {collection.name!r} holds no generated person; select one that does")


def body_of(collection: bpy.types.Collection) -> bpy.types.Object | None:
    """The body mesh of a person; None when it was deleted."""
    return next((thing for thing in collection.all_objects if thing.type == "MESH" and BODY_MARK in thing), None)


def volumes_of(collection: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """A person's volume objects by primitive, which the name of the file tells whatever the object is called now."""
    found = defaultdict(list)
    for thing in collection.all_objects:
        if thing.type == "VOLUME" and (match := PRIMITIVE_VDB.fullmatch(volume_path(thing.data).name)):
            found[int(match[1])].append(thing)
    return dict(found)


def humans(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """The people of a scene."""
    return [collection for collection in scene.collection.children_recursive if MARK in collection]


def anybody() -> bool:
    """Whether this .blend has people, in whatever scene or in none."""
    return any(MARK in collection for collection in bpy.data.collections)


def human_of(thing: bpy.types.Object | None, scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The person that an object is a part of, hangs on (a hat parented to a bone), or instances; None for others."""
    while thing is not None:
        around = set(thing.users_collection)
        for collection in humans(scene):
            if not around.isdisjoint([collection, *collection.children_recursive]):
                return collection
        if thing.instance_collection is not None and MARK in thing.instance_collection:
            return thing.instance_collection
        thing = thing.parent
    return None


def own_data(thing: bpy.types.Object, collection: bpy.types.Collection):
    """An object's data, copied first where another person's objects show it too (duplicates share data)."""
    if thing.data.users > 1:
        users = bpy.data.user_map(subset=[thing.data])[thing.data]
        if any(isinstance(user, bpy.types.Object) and user not in set(collection.all_objects) for user in users):
            thing.data = thing.data.copy()
    return thing.data


def check_editable(collection: bpy.types.Collection) -> None:
    """Raises ValueError, with what to do, for a person that lives in another .blend or has lost its armature."""
    armature = armature_of(collection)
    parts = [collection, armature, armature.data, *(thing.data for thing in collection.all_objects if thing.data)]
    linked = next((part.library for part in parts if part.library is not None), None)
    if linked is not None:
        raise ValueError(
            f"the person {collection.name!r} is linked from {linked.filepath!r}: edit it there, or make it local with "
            "Object > Relations > Make Local > All"
        )
    if not volumes_of(collection):
        raise ValueError(f"the person {collection.name!r} has no volumes left; generate a person again")


def remove_human(collection: bpy.types.Collection) -> None:
    """Take a person out of the .blend: objects, their data and the actions only they use.

    The VDB files stay, so that an undo of the removal, or an older copy of the .blend, finds them.
    """
    objects = list(collection.all_objects)
    data = [thing.data for thing in objects if thing.data is not None]
    actions = [thing.animation_data.action for thing in objects if thing.animation_data and thing.animation_data.action]
    bpy.data.batch_remove([*objects, *collection.children_recursive, collection])
    bpy.data.batch_remove([thing for thing in {*data, *actions} if thing.users == 0])
