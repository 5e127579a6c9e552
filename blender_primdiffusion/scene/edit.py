"""Edits of a human: another shape, for which bones and body mesh move to their new rest places; the
region painted for an edit by the backend; and its result in place of the human before."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from .armature import check_joints, floor_below, move_rest_joints
from .cells import scale_cells
from .convention import points_to_blender
from .human import BETA_COUNT, BETAS, LARGEST_BETA, MARK, ORIGIN, body_of, check_editable, own_data, pack, session_file
from .human_file import read_human, shape_model_of
from .shape import SAME_BETAS, Rest, betas_of, generated_betas, has_custom_shape
from .splats import replace_splats
from .volume_nodes import set_folder


def check_shapeable(person: bpy.types.Object) -> None:
    """Raises ValueError for a human whose bones or mesh cannot follow a shape now."""
    body = body_of(person)
    for obj in (person, person.data, body and body.data):
        if obj and obj.library is not None:
            raise ValueError(
                f"the human {person.name!r} is linked from {obj.library.filepath!r}: reshape it there, or "
                "make it local with Object > Relations > Make Local > All"
            )
    check_joints(person)
    if body is not None and body.data.is_editmode:
        raise ValueError(f"{body.name!r} is in Edit Mode: leave it (Tab) to change the shape")


def reshape(person: bpy.types.Object, betas: NDArray) -> str:
    """Give a human another shape [10]; returns what could not follow in a sentence, empty when everything did.

    Bones and body mesh move to their new rest places, with the soles where they were; pose and animation
    stay. Raises ValueError or FileNotFoundError before anything is touched. Makes no undo step.
    """
    betas = np.asarray(betas, np.float64)
    if betas.shape != (BETA_COUNT,) or not np.abs(betas).max() <= LARGEST_BETA:
        limit = f"{LARGEST_BETA:g}"
        raise ValueError(f"a shape is {BETA_COUNT} numbers from -{limit} to {limit}, not {betas.tolist()}")
    check_shapeable(person)
    model, generated = shape_model_of(person), generated_betas(person)
    growth = model.growth(generated, betas)
    notice = apply_rest(person, model.rest(betas), betas)
    scale_cells(person, model, betas, growth)
    return notice


def apply_rest(person: bpy.types.Object, rest: Rest, betas: NDArray) -> str:
    """Move bones and body mesh, which volumes and splats follow, to `rest`; returns a warning as `reshape` does."""
    body = body_of(person)
    bones = own_data(person, person)
    vertices = points_to_blender(rest.vertices)
    origin = floor_below(vertices)
    vertices += origin
    mesh = None if body is None else own_data(body, person)
    unchanged = mesh is not None and len(mesh.vertices) == len(vertices) and mesh.shape_keys is None
    move_rest_joints(bones, points_to_blender(rest.joints) + origin)
    bones[ORIGIN] = origin.tolist()
    bones.update_tag()
    person[BETAS] = betas.tolist()
    person.update_tag()
    if unchanged:
        mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
        mesh.update()
    return "" if body is None or unchanged else f"the mesh {body.name!r} was changed by hand and keeps its shape"


@dataclasses.dataclass(frozen=True)
class Replaced:
    """What an edit has changed."""

    reshaped: bool
    """The body has another shape: bones and body mesh have moved."""
    warning: str
    """What could not be done, in a sentence; empty otherwise."""


def replace_person(person: bpy.types.Object, file: Path) -> Replaced:
    """Show the human of a file where `person` shows another.

    Armature, pose, animation, transform, names, materials and other changes by hand stay. Where the edit has changed
    the betas, the bones' rest and the body mesh follow, unless the user has given the human a custom shape, which
    stays. Makes no undo step.

    Raises as `read_human` and `check_editable` before the scene is touched.
    """
    human = read_human(file)
    betas = human.payload.betas.astype(np.float64)
    check_editable(person)
    new_betas = not np.allclose(betas, generated_betas(person), atol=SAME_BETAS)
    custom = has_custom_shape(person)
    reshaped = new_betas and not custom
    if reshaped:
        check_shapeable(person)
    growth = human.model.growth(betas, betas_of(person)) if custom else np.ones((len(human.payload.density), 3))
    pack(person, file, own_body=human.payload.rest_half_extent is not None)
    warning = apply_rest(person, human.rest, betas) if reshaped else ""
    replace_splats(person, human)
    scale_cells(person, human.model, betas_of(person), growth)
    set_folder(person, session_file(person).parent)
    person[MARK] = human.provenance()
    person.update_tag()
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


def select_human(context: bpy.types.Context, person: bpy.types.Object) -> None:
    """Make a human active. Raises ValueError for one that cannot be selected in this view layer."""
    if context.view_layer.objects.get(person.name) != person:
        raise ValueError(f"the human {person.name!r} is not in this view layer: enable its collection first")
    leave_mode(context)
    for obj in context.view_layer.objects.selected:
        obj.select_set(False)
    person.select_set(True)
    context.view_layer.objects.active = person
