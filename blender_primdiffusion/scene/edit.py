"""Edits of a human: the region painted for one, and its result in place of the human before."""

from __future__ import annotations

import dataclasses
import os

import bpy
import numpy as np
from numpy.typing import NDArray

from .human import HOME, MARK, armature_of, check_editable, own_data, stored_path, volume_name, volumes_of
from .proxy import follow_shape, proxy_of
from .reshape import apply_growth, apply_rest, check_shapeable
from .shape import SAME_BETAS, betas_of, generated_betas, has_custom_shape
from .states import PreparedHuman
from .volumes import reload_volume


@dataclasses.dataclass(frozen=True)
class Replaced:
    """What an edit has changed."""

    reshaped: bool
    """The body has another shape: bones, body mesh and volumes have moved."""
    warning: str
    """What could not be done, in a sentence; empty otherwise."""


def replace_person(collection: bpy.types.Collection, prepared: PreparedHuman) -> Replaced:
    """Show the prepared human where `collection` shows another: its next state.

    Armature, pose, animation, transform, names, materials and other changes by hand stay, as do deleted volumes. Where
    the edit has changed the betas, the bones' rest, the body mesh and the volumes' places follow, unless the user has
    given the human a custom shape, which stays. Makes no undo step.

    Raises ValueError or FileNotFoundError before the scene is touched, and then leaves no files.
    """
    with prepared.entering():
        return _replace(collection, prepared)


def _replace(collection: bpy.types.Collection, prepared: PreparedHuman) -> Replaced:
    human, betas = prepared.human, prepared.human.payload.betas.astype(np.float64)
    check_editable(collection)
    shown, count = volumes_of(collection), len(human.payload.density)
    if max(shown) >= count:
        raise ValueError(
            f"the human {collection.name!r} has a volume {max(shown)} and the edited one only {count}; "
            "use an add-on and a backend of the same release"
        )
    new_betas = not np.allclose(betas, generated_betas(collection), atol=SAME_BETAS)
    custom = has_custom_shape(collection)
    reshaped = new_betas and not custom
    if reshaped:
        check_shapeable(collection)
    growth = human.model.growth(betas, betas_of(collection)) if custom else np.ones((count, 3))
    warning = apply_rest(collection, human.rest, betas, growth) if reshaped else ""
    if reshaped:
        follow_shape(collection, proxy_of(collection), betas)
    if new_betas and custom:
        apply_growth(collection, growth)
    folder = stored_path(prepared.folder)
    for k, objects in shown.items():
        for obj in objects:
            volume = own_data(obj, collection)
            volume.filepath = os.path.join(folder, volume_name(k))
            if volume.grids.error_message:  # its file was missing
                reload_volume(volume)
    collection[MARK] = prepared.provenance
    collection[HOME] = str(prepared.folder)
    armature_of(collection).update_tag()
    return Replaced(reshaped, warning)


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
