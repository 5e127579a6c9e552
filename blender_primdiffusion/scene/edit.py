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

from .files import PERSON, available_name, content_name, home_of, person_file_name, stored_path, volume_path
from .grid_cache import reload_volume
from .human import MARK, armature_of, check_editable, own_data, volumes_of
from .proxy import follow_shape, proxy_of
from .reshape import apply_growth, apply_rest, check_shapeable
from .shape import betas_of, generated_betas, has_custom_shape, saved_body
from .shape_model import SAME_BETAS, Rest
from .writing import Destination, WrittenHuman


@dataclasses.dataclass(frozen=True)
class Replaced:
    """What an edit has changed."""

    volumes: int
    """How many show another file."""
    of: int
    """How many the human has."""
    reshaped: bool
    """The body has another shape: bones, body mesh and volumes have moved."""
    warning: str
    """What could not be done, in a sentence; empty otherwise."""


def edit_destination(collection: bpy.types.Collection) -> Destination:
    """Where `replace_person` wants the volumes of the edited human."""
    shown = volumes_of(collection)
    files = {volume_path(obj.data) for objects in shown.values() for obj in objects}
    return Destination(home_of(collection), tuple(shown), frozenset(path for path in files if path.is_file()))


def replace_person(collection: bpy.types.Collection, written: WrittenHuman, person: Path) -> Replaced:
    """Show the written human where `collection` shows another, and store the backend's file `person` of it.

    Armature, pose, animation, transform, names, materials and other changes by hand stay, as do deleted volumes.
    Volumes whose file differs get the new one. Where the edit has changed the betas, the bones' rest, the body mesh and
    the volumes' places follow, unless the user has given the human a custom shape, which stays. Makes no undo step.

    Raises VolumeWriteError, ValueError or FileNotFoundError before the scene is touched.
    """
    with written.entering(lambda: home_of(collection)):
        return _replace(collection, written, person)


def _replace(collection: bpy.types.Collection, written: WrittenHuman, person: Path) -> Replaced:
    human = written.human
    check_editable(collection)
    shown = volumes_of(collection)
    if max(shown) >= len(human.density):
        raise ValueError(
            f"the person {collection.name!r} has a volume {max(shown)} and the edited one only {len(human.density)}; "
            "use an add-on and a backend of the same release"
        )
    new_betas = not np.allclose(human.betas, generated_betas(collection), atol=SAME_BETAS)
    custom = has_custom_shape(collection)
    reshaped = new_betas and not custom
    if reshaped:
        check_shapeable(collection)
    growth = np.ones((len(human.density), 3))
    if custom and human.shape_model is not None:
        growth = human.shape_model.growth(human.betas, betas_of(collection))
    home, name = home_of(collection), content_name(person)
    with (
        written.files_in(home, shown, {name: person}) as files,
        saved_body(collection, human.shape_model, home.parent),
    ):
        pass  # the files must exist before volumes point to them: Blender keeps the error of a missing one
    rest = Rest(human.vertices, human.joints, human.position, human.rotation)
    warning = apply_rest(collection, rest, human.betas, growth) if reshaped else ""
    if reshaped and human.shape_model is not None:
        follow_shape(collection, proxy_of(collection), human.betas)
    if new_betas and custom:
        apply_growth(collection, growth)
    changed = 0
    for k, objects in shown.items():
        for obj in objects:
            if volume_path(obj.data) != files[k]:
                own_data(obj, collection).filepath = stored_path(files[k])
                changed += 1
            if obj.data.grids.error_message:  # its file was missing
                reload_volume(obj.data)
    collection[MARK] = written.provenance
    collection[PERSON] = name
    armature_of(collection).update_tag()
    return Replaced(changed, sum(map(len, shown.values())), reshaped, warning)


def restore_destination(collection: bpy.types.Collection) -> Destination:
    """Where `restore_volumes` wants the volumes whose files are missing."""
    missing = _without_files(collection)
    which = tuple(k for k, objects in volumes_of(collection).items() if missing.intersection(objects))
    return Destination(home_of(collection), which)


def restore_volumes(collection: bpy.types.Collection, written: WrittenHuman, person: Path) -> int:
    """Point volumes without files to the written ones, and count them.

    `written` is what the backend has made of its file `person` of this human. Everything else stays: pose, shape,
    names, and volumes that have their files. The backend's and the body's files are put back too. Raises
    VolumeWriteError or ValueError before the scene is touched. Makes no undo step.
    """
    shown = [obj for objects in volumes_of(collection).values() for obj in objects]
    made = {path.resolve() for path in written.made}
    lost = _without_files(collection) | {obj for obj in shown if volume_path(obj.data).resolve() in made}
    with written.entering(lambda: home_of(collection)):
        return _restore(collection, written, lost, person)


def _without_files(collection: bpy.types.Collection) -> set[bpy.types.Object]:
    shown = volumes_of(collection)
    return {obj for objects in shown.values() for obj in objects if not volume_path(obj.data).is_file()}


def _restore(collection: bpy.types.Collection, written: WrittenHuman, lost: set[bpy.types.Object], person: Path) -> int:
    human = written.human
    check_editable(collection)
    shown = volumes_of(collection)
    if max(shown) >= len(human.density):
        raise ValueError(
            f"the person {collection.name!r} has a volume {max(shown)} and {person.name!r} only {len(human.density)}: "
            "it is the file of another person"
        )
    home = home_of(collection)
    which = [k for k, objects in shown.items() if lost.intersection(objects)]
    name = available_name(person, home, person_file_name(collection))
    with (
        written.files_in(home, which, {name: person}) as files,
        saved_body(collection, human.shape_model, home.parent),
    ):
        pass  # as in `_replace`
    for k in which:
        for obj in lost.intersection(shown[k]):
            obj.data.filepath = stored_path(files[k])
    if name != person_file_name(collection):
        collection[PERSON] = name
    restored = {obj.data for obj in lost}
    for volume in restored:
        reload_volume(volume)
    return len(restored)
