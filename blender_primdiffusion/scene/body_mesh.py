"""The proxy: the body's surface, skinned to the armature, for snapping and collision; not rendered."""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy

from ..formats.joints import JOINT_NAMES

if TYPE_CHECKING:
    from numpy.typing import NDArray

MARK = "primdiffusion_body"
"""Custom property of a body mesh: the engine leaves it out, shown or hidden."""


def build_body_mesh(
    name: str,
    armature: bpy.types.Object,
    vertices: NDArray,
    faces: NDArray,
    uv_corner: NDArray,
    skin_weights: NDArray,
) -> bpy.types.Object:
    """A mesh object, linked to no collection: vertices [V, 3] z up in the armature's space, faces [F, 3], uv [F, 3, 2].

    Vertex groups carry skin_weights [V, 24]; the Armature modifier blends matrices linearly (preserve volume off), as
    SMPL does. It is hidden in renders and in the viewport: the volumes are what one looks at.
    """
    import numpy as np  # not for those who ask for `body_of` alone: Blender starts without it

    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", np.asarray(vertices, np.float32).ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", np.asarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    uv_layer = mesh.uv_layers.new(name="UVMap")
    uv_layer.data.foreach_set("uv", np.asarray(uv_corner, np.float32).ravel())
    mesh.update(calc_edges=True)
    if mesh.validate():
        raise ValueError(f"the body surface of {name!r} has impossible faces; generate the person again")
    mesh.shade_smooth()

    body = bpy.data.objects.new(name, mesh)
    for joint, bone in enumerate(JOINT_NAMES):
        group = body.vertex_groups.new(name=bone)
        for vertex in np.flatnonzero(skin_weights[:, joint]):
            group.add([int(vertex)], float(skin_weights[vertex, joint]), "REPLACE")
    body.parent = armature
    modifier = body.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature
    modifier.use_deform_preserve_volume = False
    body[MARK] = True
    body.hide_render = True
    body.hide_viewport = True
    return body


def body_of(collection: bpy.types.Collection) -> bpy.types.Object | None:
    """The body mesh of a person; None when it was deleted."""
    return next((thing for thing in collection.all_objects if thing.type == "MESH" and MARK in thing), None)
