"""Edits of a human: the region painted for one, its result in place of the human before, and restored volumes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.regular_files import exists_in_its_folder, real_path
from .attachment import volumes_may_wait
from .body_file import saved_body
from .human import (
    MARK,
    PERSON,
    armature_of,
    available_name,
    check_editable,
    content_name,
    home_of,
    own_data,
    person_file_name,
    stored_path,
    volume_path,
    volumes_of,
)
from .human_npz import Destination, WrittenHuman
from .proxy import follow_shape, proxy_of
from .reshape import apply_growth, apply_rest, check_shapeable
from .shape import SAME_BETAS, Rest, betas_of, generated_betas, has_custom_shape
from .volumes import reload_volume


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
    return Destination(home_of(collection), tuple(volumes_of(collection)), volumes_may_wait(collection))


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
            f"the human {collection.name!r} has a volume {max(shown)} and the edited one only {len(human.density)}; "
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
    made = {real_path(path) for path in written.made}
    written_again = {obj for obj in shown if (path := volume_path(obj.data)) is not None and real_path(path) in made}
    lost = _without_files(collection) | written_again
    with written.entering(lambda: home_of(collection)):
        return _restore(collection, written, lost, person)


def _without_files(collection: bpy.types.Collection) -> set[bpy.types.Object]:
    shown = volumes_of(collection)
    paths = {obj: volume_path(obj.data) for objects in shown.values() for obj in objects}
    return {obj for obj, path in paths.items() if path is None or not exists_in_its_folder(path)}


def _restore(collection: bpy.types.Collection, written: WrittenHuman, lost: set[bpy.types.Object], person: Path) -> int:
    human = written.human
    check_editable(collection)
    shown = volumes_of(collection)
    if max(shown) >= len(human.density):
        raise ValueError(
            f"the human {collection.name!r} has a volume {max(shown)} and {person.name!r} only {len(human.density)}: "
            "it is the file of another human"
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


def painted_weights(body: bpy.types.Object, group: str) -> NDArray[np.float32]:
    """The weights [V] of a vertex group, 0 where a vertex is not in it.

    Raises ValueError when there is no such group, or nothing is painted in it.
    """
    if group not in body.vertex_groups:
        raise ValueError(f"the body mesh {body.name!r} has no vertex group {group!r}: press Paint Region first")
    if body.mode == "EDIT":
        body.update_from_editmode()
    index = body.vertex_groups[group].index
    weights = np.zeros(len(body.data.vertices), np.float32)
    for vertex in body.data.vertices:
        for element in vertex.groups:
            if element.group == index:
                weights[vertex.index] = element.weight
    if not weights.any():
        raise ValueError(f"nothing is painted in the vertex group {group!r} of {body.name!r}: paint where to edit")
    return weights


def start_painting(context: bpy.types.Context, body: bpy.types.Object, group: str) -> None:
    """Show the body mesh, make the vertex group if there is none, and enter Weight Paint mode with it.

    Raises ValueError for a mesh that cannot be painted in this view layer.
    """
    if body.library is not None or body.data.library is not None:
        raise ValueError(f"the body mesh {body.name!r} is linked from another .blend: it cannot be painted here")
    if context.view_layer.objects.get(body.name) != body:
        raise ValueError(f"the body mesh {body.name!r} is not in this view layer: enable its collection first")
    leave_mode(context)
    body.hide_viewport = False
    body.hide_set(False)
    body.hide_select = False
    if not body.visible_get():
        body.hide_viewport = True
        raise ValueError(f"the body mesh {body.name!r} is hidden with its collection: show that first")
    body.show_in_front = True
    made = body.vertex_groups.get(group) or body.vertex_groups.new(name=group)
    body.vertex_groups.active = made
    for obj in context.selected_objects:
        obj.select_set(False)
    body.select_set(True)
    context.view_layer.objects.active = body
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")


def end_painting(context: bpy.types.Context, body: bpy.types.Object) -> None:
    """Return to Object mode and hide the body mesh."""
    leave_mode(context)
    body.show_in_front = False
    body.hide_viewport = True


def leave_mode(context: bpy.types.Context) -> None:
    """Return to Object mode from any other."""
    active = context.view_layer.objects.active
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


def select_human(context: bpy.types.Context, person: bpy.types.Collection) -> None:
    """Make a human's armature active. Raises ValueError for one that cannot be selected in this view layer."""
    armature = armature_of(person)
    if context.view_layer.objects.get(armature.name) != armature:
        raise ValueError(f"the armature of {person.name!r} is not in this view layer: enable its collection first")
    leave_mode(context)
    for obj in context.view_layer.objects.selected:
        obj.select_set(False)
    armature.select_set(True)
    context.view_layer.objects.active = armature
