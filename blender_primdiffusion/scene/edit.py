"""Show an edited human in place of the one before, and restore volumes whose files are lost.

Only what differs is touched. Every file that an edit writes has a new name, in the folder of the human's other files:
the volumes' paths and the name of the human's own file are part of the .blend, so undo and redo switch between states
whose files all exist.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import bpy
import numpy as np

from . import volumes
from .beforehand import Baked, Place, Written, bake
from .files import PERSON, free_name, home_of, named_by_content, person_file_name, stored_path, volume_path
from .grid_cache import read_again
from .human import MARK, armature_of, check_editable, own_data, volumes_of
from .proxy import follow_shape, proxy_of
from .reshape import check_shapeable, show_growth, show_rest
from .shape import betas_of, generated_betas, keeps_own_shape, saved_body
from .shape_model import SAME_BETAS, Rest


@dataclasses.dataclass(frozen=True)
class Replaced:
    """What an edit has changed."""

    volumes: int
    """How many show another file."""
    of: int
    """How many the person has."""
    reshaped: bool
    """The body has another shape: bones, body mesh and places of the volumes have moved."""
    warning: str
    """What could not be done, in a sentence; empty otherwise."""


def replace_person(collection: bpy.types.Collection, human_npz: Path, person: Path) -> Replaced:
    """Show the person of a human.npz where `collection` shows another, and keep the backend's file `person` of it.

    Armature, pose, animation, transform, names, materials and what else was changed by hand stay. Volumes whose file
    would be another get it; volumes that were deleted stay deleted. Where the edit has changed the betas, the bones'
    rest, the body mesh and the volumes' places move too, unless somebody has given the person a shape of their own
    since they were generated or last edited: that stays. Raises HumanFileError, VolumeWriteError, ValueError or
    FileNotFoundError before anything in the scene is touched. Takes up to some seconds; makes no undo step, its caller
    does.
    """
    return _replace(collection, bake(human_npz), person)


def replace_by_written(collection: bpy.types.Collection, written: Written, person: Path) -> Replaced:
    """As `replace_person`, quickly, by somebody whose volumes are written: where `place_of` said, or, if the person has
    gone elsewhere meanwhile, there once more."""
    with written.entering(lambda: home_of(collection)):
        return _replace(collection, written.baked, person)


def place_of(collection: bpy.types.Collection) -> Place:
    """Where volumes of the person go when they become another."""
    shown = volumes_of(collection)
    files = {volume_path(thing.data) for objects in shown.values() for thing in objects}
    return Place(home_of(collection), tuple(shown), frozenset(path for path in files if path.is_file()))


def _replace(collection: bpy.types.Collection, baked: Baked, person: Path) -> Replaced:
    human, grids = baked.human, baked.grids
    check_editable(collection)
    shown = volumes_of(collection)
    if max(shown) >= len(human.density):
        raise ValueError(
            f"the person {collection.name!r} has a volume {max(shown)} and the edited one only {len(human.density)}; "
            "use an add-on and a backend of the same release"
        )
    other, own = not np.allclose(human.betas, generated_betas(collection), atol=SAME_BETAS), keeps_own_shape(collection)
    reshaped = other and not own
    if reshaped:
        check_shapeable(collection)
    growth = np.ones((len(human.density), 3))
    if own and human.shape_model is not None:
        growth = human.shape_model.growth(human.betas, betas_of(collection))
    home, files = home_of(collection), {}
    for k in shown:
        files[k] = home / volumes.file_name(grids, k, bpy.app.version)
    name = named_by_content(person)
    missing = [k for k, path in files.items() if not path.is_file()]
    with volumes.written(grids, home, {name: person}, missing), saved_body(collection, human.shape_model, home.parent):
        pass
    rest = Rest(human.vertices, human.joints, human.position, human.rotation)
    warning = show_rest(collection, rest, human.betas, growth) if reshaped else ""
    if reshaped and human.shape_model is not None:
        follow_shape(collection, proxy_of(collection), human.betas)
    if other and own:
        show_growth(collection, growth)
    changed = 0
    for k, objects in shown.items():
        for thing in objects:
            if volume_path(thing.data) != files[k]:
                own_data(thing, collection).filepath = stored_path(files[k])
                changed += 1
            if thing.data.grids.error_message:  # its file was missing, and is there now
                read_again(thing.data)
    collection[MARK] = baked.provenance
    collection[PERSON] = name
    armature_of(collection).update_tag()
    return Replaced(changed, sum(map(len, shown.values())), reshaped, warning)


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
    with volumes.written(grids, home, {name: person}, absent), saved_body(collection, human.shape_model, home.parent):
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
