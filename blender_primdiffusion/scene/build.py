"""Build a human in the scene: an armature with body mesh, and splats or volumes, as its children."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from .armature import build_armature, floor_below
from .convention import points_to_blender
from .human import BETAS, BODY_MARK, MARK, ORIGIN, body_of, link_part, pack
from .human_file import GENERATE_AGAIN, read_human, shape_model_of
from .representation import set_representation
from .shape import betas_of
from .splats import SPLATS_AVAILABLE

NAME_LENGTH = 40
"""Characters of a new human's name; names of its parts are longer, and Blender allows 63."""

_ABOUT_BETAS = "Shape of the body. The sliders in the sidebar set it; keys and drivers move the engine's picture alone"
_KINDS = (
    "collections", "objects", "volumes", "meshes", "armatures", "actions", "materials", "images", "pointclouds",
    "node_groups",
)  # fmt: skip


def build_human(
    context: bpy.types.Context, file: str | Path, name: str = "Human", remedy: str = GENERATE_AGAIN
) -> bpy.types.Object:
    """Build the human of a file in a collection of their own: an armature that holds the file, and its parts.

    The human faces -y and stands at the world's origin. The armature's origin is on the floor below the pelvis; in its
    space, the backend's axes are turned z up and the body is raised by ORIGIN. Raises as `read_human`, and then leaves
    no data. Makes no undo step.
    """
    file = Path(file)
    human = read_human(file, remedy)
    with _no_data_left_on_failure():
        collection = bpy.data.collections.new(name[:NAME_LENGTH])
        origin = floor_below(points_to_blender(human.rest.vertices))
        person = build_armature(collection.name, points_to_blender(human.rest.joints) + origin)
        pack(person, file, own_body=human.payload.rest_half_extent is not None)
        person.data[ORIGIN] = origin.tolist()
        person[BETAS] = human.payload.betas.tolist()
        person.id_properties_ui(BETAS).update(description=_ABOUT_BETAS)
        person[MARK] = human.provenance()
        collection.objects.link(person)
        build_missing_parts(person)
        context.scene.collection.children.link(collection)
    return person


def build_missing_parts(person: bpy.types.Object) -> None:
    """Give a human, such as a copy of the armature alone, its body, and splats or, before Blender 5.3, volumes.

    Raises as `read_human` does, and then leaves no data. Makes no undo step.
    """
    with _no_data_left_on_failure():
        if body_of(person) is None:
            _build_body(person)
        set_representation(person, "SPLATS" if SPLATS_AVAILABLE else "VOLUMES")


def _build_body(person: bpy.types.Object) -> None:
    """The hidden body mesh."""
    model = shape_model_of(person)
    vertices = points_to_blender(model.surface(betas_of(person)))
    vertices += floor_below(vertices)
    label = f"{person.name}_body"
    link_part(person, build_body_mesh(label, person, vertices, model.faces, model.uv_corner, model.skin_weights))


@contextmanager
def _no_data_left_on_failure() -> Iterator[None]:
    """When the block fails, remove every datablock made in it."""
    before = {kind: set(getattr(bpy.data, kind)) for kind in _KINDS}
    try:
        yield
    except BaseException:
        new = [block for kind in _KINDS for block in getattr(bpy.data, kind) if block not in before[kind]]
        bpy.data.batch_remove(new)
        raise


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
    SMPL does. It is hidden in renders and in the viewport, where the volumes show instead.
    """
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
        raise ValueError(f"the body surface of {name!r} has impossible faces; generate the human again")
    mesh.shade_smooth()

    body = bpy.data.objects.new(name, mesh)
    for joint, bone in enumerate(JOINT_NAMES):
        group = body.vertex_groups.new(name=bone)
        for vertices_alike, weight in _by_weight(skin_weights[:, joint]):
            group.add(vertices_alike, weight, "REPLACE")
    body.parent = armature
    modifier = body.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature
    modifier.use_deform_preserve_volume = False
    body[BODY_MARK] = True
    body.hide_render = True
    body.hide_viewport = True
    return body


def _by_weight(weights: NDArray) -> Iterator[tuple[list[int], float]]:
    """Vertices of the same non-zero weight, and the weight, of weights [V]."""
    vertices = np.flatnonzero(weights)
    vertices = vertices[np.argsort(weights[vertices], kind="stable")]
    ordered = weights[vertices]
    starts = np.flatnonzero(np.diff(ordered, prepend=np.nan)).tolist()
    alike = vertices.tolist()
    for start, end in itertools.pairwise([*starts, len(alike)]):
        yield alike[start:end], float(ordered[start])
