"""People of a scene: who they are, where their files are, and how they leave. How they come to be is in `build`."""

from __future__ import annotations

from pathlib import Path

import bpy

from .folders import humans_folder

MARK = "primdiffusion_human"
"""Custom property of a person's collection: its provenance as JSON."""
BETAS = "primdiffusion_betas"
"""Custom property of a person's armature: the body's shape, which the engine draws and which may be animated."""
PERSON_FILE = "person.human.safetensors"
"""The person as the backend keeps it, beside the volumes."""
PERSON = "primdiffusion_person_file"
"""Custom property of a person's collection: the name of the backend's file since the person was edited. It goes back
and forth with undo, as the paths of the volumes do."""
HOME = "primdiffusion_folder"
"""Custom property of a person's collection: the absolute folder of their files when the .blend was last saved. Paths
of volumes are relative to the .blend, which may be moved alone, or opened as a copy in a temporary folder."""
CYCLES_LIMIT = 31
"""Volumes that Cycles draws at a point."""


class MissingPersonFile(FileNotFoundError):
    """The backend's file of a person is not where it should be."""

    kind = "missing_volumes"
    """By which panels find the remedy."""


def folder_of(collection: bpy.types.Collection) -> Path:
    """Where a person's files live: `<blendname>_humans/<collection name>` (see `humans_folder`)."""
    return humans_folder() / bpy.path.clean_name(collection.name)


def person_file(collection: bpy.types.Collection) -> Path:
    """The backend's own file of a person: beside their volumes, wherever these are now, else in `folder_of`.

    Volumes keep their paths when a collection is renamed and when a .blend is saved elsewhere. Raises FileNotFoundError
    with a sentence that names the person and the file.
    """
    name, folders = person_file_name(collection), folders_of(collection)
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise MissingPersonFile(
        f"the file of the person {collection.name!r} is missing: {str(folders[0] / name)!r}; put it back beside "
        "the person's volumes, press Find Missing Volumes in the panel Human, or generate the person again"
    )


def folders_of(collection: bpy.types.Collection) -> list[Path]:
    """Where a person's files may be: beside the volumes as they are now, else `folder_of`."""
    volume = next((thing.data for thing in collection.all_objects if thing.type == "VOLUME"), None)
    beside = [volume_path(volume).parent] if volume is not None and volume.filepath else []
    return [*beside, folder_of(collection)]


def person_file_name(collection: bpy.types.Collection) -> str:
    """The name of `person_file`, which is another one after each edit."""
    return str(collection.get(PERSON, PERSON_FILE))


def volume_path(volume: bpy.types.Volume) -> Path:
    """The absolute path of a volume's file."""
    return Path(bpy.path.abspath(volume.filepath, library=volume.library))


def overlap_warning(collection: bpy.types.Collection) -> str | None:
    """A sentence for the user when Cycles will drop volumes of this person in their shape of now, else None."""
    from .overlap_now import overlapping_now

    try:
        most = overlapping_now(collection)
    except (ValueError, KeyError, TypeError):  # changed by hand
        return None
    if most <= CYCLES_LIMIT:
        return None
    return (
        f"up to {most} volumes of {collection.name!r} overlap at a point and Cycles draws only {CYCLES_LIMIT}; "
        "render with PrimDiffusion (Exact)"
    )


def overlap_warning_in(scene: bpy.types.Scene, collection: bpy.types.Collection) -> str | None:
    """The same where Cycles is the scene's engine: it is a matter of Cycles alone, and others need not be told."""
    return overlap_warning(collection) if scene.render.engine == "CYCLES" else None


def armature_of(collection: bpy.types.Collection) -> bpy.types.Object:
    """The person's armature object; ValueError when the collection is no person or lost it."""
    for candidate in collection.objects:
        if MARK in collection and candidate.type == "ARMATURE":
            return candidate
    raise ValueError(f"the collection {collection.name!r} holds no generated person; select one that does")


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


def people_files() -> set[str]:
    """Names of the backend's files that people of this .blend use, those linked included."""
    return {person_file_name(collection) for collection in bpy.data.collections if MARK in collection}


def remove_human(collection: bpy.types.Collection) -> None:
    """Take a person out of the .blend: objects, their data and the actions only they use.

    The VDB files stay, so that an undo of the removal, or an older copy of the .blend, finds them.
    """
    objects = list(collection.all_objects)
    data = [thing.data for thing in objects if thing.data is not None]
    actions = [thing.animation_data.action for thing in objects if thing.animation_data and thing.animation_data.action]
    bpy.data.batch_remove([*objects, *collection.children_recursive, collection])
    bpy.data.batch_remove([thing for thing in {*data, *actions} if thing.users == 0])
