"""Regions that the user paints on the body mesh as vertex groups."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray


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
