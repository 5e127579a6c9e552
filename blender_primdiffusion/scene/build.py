"""Build a human in the scene: one collection with armature, body mesh and volumes."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..formats.poses.rotation import matrix_to_quaternion
from .armature import build_armature
from .attachment import ATTACHMENT, IN_VIEWPORT, VOLUMES_IN_VIEWPORT
from .convention import frames_to_blender, points_to_blender
from .human import BETAS, BODY_MARK, HOME, MARK, ORIGIN, stored_path, volume_name
from .material import volume_material
from .splats import SPLATS_AVAILABLE, build_splats
from .stand_in import build_stand_in
from .states import NAME_LENGTH, PreparedHuman, prepare_now

_ABOUT_BETAS = "Shape of the body. The sliders in the sidebar set it; keys and drivers move the engine's picture alone"
_KINDS = ("collections", "objects", "volumes", "meshes", "armatures", "actions", "materials", "pointclouds")


def build_human(context: bpy.types.Context, person: str | Path, name: str = "Human") -> bpy.types.Collection:
    """Build the human of a file in the scene, with its volumes where they cannot come later; see `build_prepared`.

    Raises as `states.prepare`, and then leaves neither data nor files.
    """
    return build_prepared(context, prepare_now(Path(person), name), name)


def build_prepared(context: bpy.types.Context, prepared: PreparedHuman, name: str = "Human") -> bpy.types.Collection:
    """Build a human whose files are there: armature, hidden body mesh, a volume for every primitive and, in
    Blender 5.3 and newer, splats, which then show it.

    The human faces -y and stands at the world's origin. The armature's origin is on the floor below the pelvis; in its
    space, the backend's axes are turned z up and the body is raised by ORIGIN. Raises ValueError, and then leaves
    neither data nor files. Makes no undo step.
    """
    with prepared.entering():
        return _build(context, prepared, name)


def _build(context: bpy.types.Context, prepared: PreparedHuman, name: str) -> bpy.types.Collection:
    human, model, rest = prepared.human, prepared.human.model, prepared.human.rest
    if model.uv_corner is None:
        raise ValueError("the body's file is of an earlier version, without texture coordinates: import it again")
    with _no_data_left_on_failure():
        collection = bpy.data.collections.new(name[:NAME_LENGTH])
        label = collection.name
        vertices = points_to_blender(rest.vertices)
        origin = floor_below(vertices)
        armature = build_armature(label, points_to_blender(rest.joints) + origin)
        armature.data[ORIGIN] = origin.tolist()
        armature[BETAS] = human.payload.betas.tolist()
        armature.id_properties_ui(BETAS).update(description=_ABOUT_BETAS)
        collection.objects.link(armature)
        body = build_body_mesh(
            f"{label}_body", armature, vertices + origin, model.faces, model.uv_corner, model.skin_weights
        )
        collection.objects.link(body)
        primitives = bpy.data.collections.new(f"{label}_primitives")
        primitives.hide_viewport = not VOLUMES_IN_VIEWPORT
        primitives.objects.link(armature)  # the Outliner then shows the volumes inside the armature's closed row
        collection.children.link(primitives)
        attach_volumes(
            label,
            armature,
            primitives,
            [prepared.folder / volume_name(k) for k in range(len(rest.position))],
            points_to_blender(rest.position) + origin,
            frames_to_blender(rest.rotation),
            model.primitive_weights(),
            volume_material(),
        )
        if SPLATS_AVAILABLE:
            for part in build_splats(label, armature, body, human):
                collection.objects.link(part)
            collection[ATTACHMENT] = "SPLATS"
            primitives.hide_viewport = primitives.hide_render = True
        else:  # splats show without the extension
            collection.objects.link(build_stand_in(label, armature, body))
        collection[MARK] = prepared.provenance
        collection[HOME] = str(prepared.folder)
        collection[IN_VIEWPORT] = VOLUMES_IN_VIEWPORT
        context.scene.collection.children.link(collection)
    return collection


def floor_below(vertices: NDArray) -> NDArray[np.float64]:
    """The displacement [3] that puts the soles of a body at rest, vertices [V, 3], on z = 0: see `human.ORIGIN`."""
    return np.array([0.0, 0.0, -vertices[:, 2].min()])


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


def attach_volumes(
    name: str,
    armature: bpy.types.Object,
    collection: bpy.types.Collection,
    files: Sequence[Path],
    position: NDArray,
    rotation: NDArray,
    weights: NDArray,
    material: bpy.types.Material,
) -> list[bpy.types.Object]:
    """A Volume object for each file, in `collection`, with rest position [K, 3] and rotation [K, 3, 3] (z up).

    Parented to the armature, with an Armature constraint of one target per non-zero weight [K, 24] and preserve volume
    off: the evaluated matrix is A (sum_j w_j G_j) [rotation | position], with the armature object's matrix A and SMPL's
    skinning transforms G_j. It shears where joints bend, as linear blending does. Turns off the viewports' relationship
    lines, of which there would be thousands.
    """
    hide_relationship_lines()
    positions, quaternions = np.asarray(position).tolist(), matrix_to_quaternion(rotation).tolist()
    paths = [os.path.split(path) for path in files]
    folders = {folder: stored_path(Path(folder)) for folder in {folder for folder, _ in paths}}
    targets = _targets(weights)
    labels = [f"{name}_prim_{k:04d}" for k in range(len(files))]
    volumes = _volumes(f"{name}_prim", material, len(files))
    objects = [bpy.data.objects.new(label, volume) for label, volume in zip(labels, volumes, strict=True)]
    prototypes: dict[tuple[str, ...], bpy.types.ArmatureConstraint] = {}
    for k, primitive in enumerate(objects):  # a loop of its own: new data make these changes slow
        volume = volumes[k]
        folder, file = paths[k]
        volume.filepath = os.path.join(folders[folder], file)
        primitive.parent = armature
        primitive.rotation_mode = "QUATERNION"
        primitive.location = positions[k]
        primitive.rotation_quaternion = quaternions[k]
        bones = tuple(bone for bone, _ in targets[k])
        if bones in prototypes:
            constraint = primitive.constraints.copy(prototypes[bones])
        else:
            constraint = prototypes[bones] = _armature_constraint(primitive, armature, bones)
        constraint.targets.foreach_set("weight", [weight for _, weight in targets[k]])
        collection.objects.link(primitive)
    return objects


def _volumes(name: str, material: bpy.types.Material, count: int) -> list[bpy.types.Volume]:
    """New volume data without files, which Blender numbers.

    Appending a material takes a time in proportion to the number of objects in the file; copies do not.
    """
    first = bpy.data.volumes.new(name)
    first.render.space = "WORLD"
    first.materials.append(material)
    return [first, *(first.copy() for _ in range(count - 1))][:count]


def _armature_constraint(
    primitive: bpy.types.Object, armature: bpy.types.Object, bones: Sequence[str]
) -> bpy.types.ArmatureConstraint:
    """A new constraint of `primitive` with these targets, which copies have too: setting them takes longer."""
    constraint = primitive.constraints.new("ARMATURE")
    constraint.use_deform_preserve_volume = False
    for bone in bones:
        target = constraint.targets.new()
        target.target = armature
        target.subtarget = bone
    return constraint


def _targets(weights: NDArray) -> list[list[tuple[str, float]]]:
    """Bones and their non-zero weights for each row of weights [K, 24]."""
    rows, joints = np.nonzero(weights)
    found: list[list[tuple[str, float]]] = [[] for _ in weights]
    for row, joint, weight in zip(rows.tolist(), joints.tolist(), weights[rows, joints].tolist(), strict=True):
        found[row].append((JOINT_NAMES[joint], weight))
    return found


def hide_relationship_lines() -> None:
    """Turn Blender's dashed lines from children to parents off in the 3D viewports of all workspaces: a human's
    volumes would have two thousand. Overlays > Relationship Lines shows them again."""
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type == "VIEW_3D":
                    space.overlay.show_relationship_lines = False
