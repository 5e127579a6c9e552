"""Volumes written again from the backend's file of a person, where theirs are lost."""

from __future__ import annotations

from pathlib import Path

import bpy

from . import volumes
from .edited import check_editable, home_of
from .folders import stored_path
from .human import PERSON, person_file_name, volume_path
from .human_file import read_human
from .placing_files import free_name
from .shape import volumes_of
from .shape_file import body_kept


def restore_volumes(collection: bpy.types.Collection, human_npz: Path, person: Path) -> int:
    """Write the volumes of a person whose files are missing, point to them, and count them.

    `human_npz` is what the backend has made of its file `person` of them. Everything else of the person stays: pose,
    shape, names, and volumes that have their files. The backend's and the body's files are put back too. Raises
    HumanFileError, VolumeWriteError or ValueError before anything in the scene is touched; makes no undo step.
    """
    human = read_human(human_npz)
    check_editable(collection)
    shown = volumes_of(collection)
    if max(shown) >= len(human.density):
        raise ValueError(
            f"the person {collection.name!r} has a volume {max(shown)} and {person.name!r} only {len(human.density)}: "
            "it is somebody else's file"
        )
    grids = volumes.bake(human.density, human.rgb, human.half_extent)
    home = home_of(collection)
    lost = {thing for objects in shown.values() for thing in objects if not volume_path(thing.data).is_file()}
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
    for thing in lost:
        thing.data.grids.unload()
    return len({thing.data for thing in lost})
