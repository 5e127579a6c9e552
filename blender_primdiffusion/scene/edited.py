"""A person after an edit, in the place of the person before it.

Only what differs is touched. Every file that an edit writes has a new name, in the folder of the person's others: the
volumes' paths and the name of the person's own file are part of the .blend, so undo and redo go back and forth between
states whose files all stay. `unused` finds those that no state of this .blend as it is now points to.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import bpy
import numpy as np

from . import merged, shape_file, volumes
from .beforehand import Baked, Place, Written, bake
from .exported_proxy import proxy_of
from .folders import humans_folder, stored_path
from .grid_warming import read_again
from .human import MARK, PERSON, armature_of, folder_of, folders_of, people_files, person_file_name, volume_path
from .placing_files import named_by_content
from .proxy_shape import follow_shape
from .shape import (
    PRIMITIVE,
    SAME_BETAS,
    betas_of,
    check_shapeable,
    generated_betas,
    keeps_own_shape,
    own_data,
    show_growth,
    show_rest,
    volumes_of,
)
from .shape_file import body_files, body_kept
from .shape_model import Rest

_PERSON = re.compile(r"person(_[0-9a-f]{12})?\.human\.safetensors")


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
    with volumes.written(grids, home, {name: person}, missing), body_kept(collection, human.shape_model, home.parent):
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


def unused(folder: Path) -> list[Path]:
    """Files of people in `folder` that nothing in the .blend, as it is now, points to: of earlier states of people.

    Undo may still want them, and so may other .blend files that share the folder.
    """
    if not folder.is_dir():
        return []
    used = {path.resolve() for volume in bpy.data.volumes if volume.filepath for path in merged.sequence_files(volume)}
    kept = people_files() | body_files()
    found = []
    for path in sorted(folder.rglob("*")):
        of_people = any(pattern.fullmatch(path.name) for pattern in (PRIMITIVE, _PERSON, shape_file.NAME, merged.FILE))
        if of_people and path.name not in kept and path.resolve() not in used:
            found.append(path)
    return found


def home_of(collection: bpy.types.Collection) -> Path:
    """The folder of the person's files, if it belongs to this .blend.

    Else (saved under another name, appended from another .blend) a folder of its own, into which all of the person
    goes, so that nobody is ever in two places.
    """
    folders = folders_of(collection)
    home = next((folder for folder in folders if (folder / person_file_name(collection)).is_file()), folders[0])
    for own in (humans_folder(), humans_folder("")):
        if home.resolve().is_relative_to(own.resolve()):
            return home
    return folder_of(collection)
