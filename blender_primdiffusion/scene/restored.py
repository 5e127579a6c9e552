"""Volumes written again from the backend's file of a person, where theirs are lost."""

from __future__ import annotations

from pathlib import Path

import bpy

from . import volumes
from .beforehand import Baked, Place, Written, bake
from .edited import check_editable, home_of
from .folders import stored_path
from .grid_warming import read_again
from .human import PERSON, person_file_name, volume_path
from .placing_files import free_name
from .shape import volumes_of
from .shape_file import body_kept


def restore_volumes(collection: bpy.types.Collection, human_npz: Path, person: Path) -> int:
    """Write the volumes of a person whose files are missing, point to them, and count them.

    `human_npz` is what the backend has made of its file `person` of them. Everything else of the person stays: pose,
    shape, names, and volumes that have their files. The backend's and the body's files are put back too. Raises
    HumanFileError, VolumeWriteError or ValueError before anything in the scene is touched; makes no undo step.
    """
    return _restore(collection, bake(human_npz), _lost(collection), person)


def restore_written(collection: bpy.types.Collection, written: Written, person: Path) -> int:
    """As `restore_volumes`, quickly, where they are written already: to `place_of_lost`, or, if the person has gone
    elsewhere meanwhile, there once more."""
    shown = [thing for objects in volumes_of(collection).values() for thing in objects]
    made = {path.resolve() for path in written.made}
    lost = _lost(collection) | {thing for thing in shown if volume_path(thing.data).resolve() in made}
    with written.entering(lambda: home_of(collection)):
        return _restore(collection, written.baked, lost, person)


def place_of_lost(collection: bpy.types.Collection) -> Place:
    """Where the volumes of a person go whose files are missing, and which these are."""
    lost = _lost(collection)
    which = tuple(k for k, objects in volumes_of(collection).items() if lost.intersection(objects))
    return Place(home_of(collection), which)


def _lost(collection: bpy.types.Collection) -> set[bpy.types.Object]:
    shown = volumes_of(collection)
    return {thing for objects in shown.values() for thing in objects if not volume_path(thing.data).is_file()}


def _restore(collection: bpy.types.Collection, baked: Baked, lost: set[bpy.types.Object], person: Path) -> int:
    human, grids = baked.human, baked.grids
    check_editable(collection)
    shown = volumes_of(collection)
    if max(shown) >= len(human.density):
        raise ValueError(
            f"the person {collection.name!r} has a volume {max(shown)} and {person.name!r} only {len(human.density)}: "
            "it is somebody else's file"
        )
    home = home_of(collection)
    files = {k: home / volumes.file_name(grids, k, bpy.app.version) for k in shown}
    absent = [k for k, objects in shown.items() if lost.intersection(objects) and not files[k].is_file()]
    name = free_name(person, home, person_file_name(collection))
    with volumes.written(grids, home, {name: person}, absent), body_kept(collection, human.shape_model, home.parent):
        pass
    for k, objects in shown.items():
        for thing in lost.intersection(objects):
            thing.data.filepath = stored_path(files[k])
    if name != person_file_name(collection):
        collection[PERSON] = name
    found = {thing.data for thing in lost}
    for volume in found:
        read_again(volume)
    return len(found)
