"""Build a human in the scene: one collection with armature, body mesh and volumes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from . import volumes
from .armature import build_armature
from .beforehand import Baked, Written, bake
from .convention import frames_to_blender, matrix_to_quaternion, points_to_blender
from .files import HOME, PERSON, folder_of, free_name, humans_folder, stored_path, volume_path
from .grid_cache import read_headers
from .human import BETAS, BODY_MARK, MARK, armature_of, humans
from .material import volume_material
from .shape import saved_body

_NAME_LENGTH = 40
_ABOUT_BETAS = "Shape of the body. The sliders in the sidebar set it; keys and drivers move the engine's picture alone"
_KINDS = ("collections", "objects", "volumes", "meshes", "armatures", "actions", "materials")
GAP_M = 0.2
"""Between the hands of two people in the T pose."""
_FLESH_M = 0.1
"""Around bones."""


def build_human(
    context: bpy.types.Context, human_npz: str | Path, name: str = "Human", keep: Sequence[Path] = ()
) -> bpy.types.Collection:
    """Build the person of a human.npz in the scene: armature, hidden body mesh and a volume for every primitive.

    The person faces -y with the soles on z = 0 at the world's origin: the armature object is lifted, its space is the
    backend's turned z up. Volumes are written to `folder_of(collection)`, the files in `keep` are copied beside them,
    and the body's file is put beside that folder. Raises HumanFileError or VolumeWriteError, and then leaves neither
    data nor files. Takes several seconds; makes no undo step, its caller does.
    """
    person = _build(context, bake(human_npz), None, name, keep)
    read_headers(volume_path(thing.data) for thing in person.all_objects if thing.type == "VOLUME")
    return person


def build_written(
    context: bpy.types.Context, written: Written, name: str = "Human", keep: Sequence[Path] = ()
) -> bpy.types.Collection:
    """As `build_human`, quickly, of a person whose volumes are written: where they are, or, if somebody else has taken
    that place meanwhile, as copies elsewhere."""
    with written.entering(lambda: folder_of(person)):
        person = _build(context, written.baked, written, name, keep)
    return person


def home_of_next(name: str) -> Path:
    """`folder_of` the person who is built under this name next, as far as can be told: Blender numbers names."""
    name = name[:_NAME_LENGTH]
    taken = {collection.name for collection in bpy.data.collections if collection.library is None}
    numbered = (f"{name}.{number:03d}" for number in itertools.count(1))
    free = name if name not in taken else next(one for one in numbered if one not in taken)
    return humans_folder() / bpy.path.clean_name(free)


def _build(
    context: bpy.types.Context, baked: Baked, written: Written | None, name: str, keep: Sequence[Path]
) -> bpy.types.Collection:
    human = baked.human
    with _nothing_left_on_failure():
        collection = bpy.data.collections.new(name[:_NAME_LENGTH])
        label = collection.name
        armature = build_armature(label, points_to_blender(human.joints))
        armature[BETAS] = human.betas.tolist()
        armature.id_properties_ui(BETAS).update(description=_ABOUT_BETAS)
        collection.objects.link(armature)
        vertices = points_to_blender(human.vertices)
        armature.location = (0.0, 0.0, -vertices[:, 2].min())
        body = build_body_mesh(f"{label}_body", armature, vertices, human.faces, human.uv_corner, human.skin_weights)
        collection.objects.link(body)
        primitives = bpy.data.collections.new(f"{label}_primitives")
        collection.children.link(primitives)
        home = folder_of(collection)
        kept = {free_name(path, home, path.name): path for path in keep}
        with (
            _volumes(baked, written, home, kept) as files,
            saved_body(collection, human.shape_model, home.parent),
        ):
            attach_volumes(
                label,
                armature,
                primitives,
                files,
                points_to_blender(human.position),
                frames_to_blender(human.rotation),
                human.primitive_weights,
                volume_material(),
            )
            collection[MARK] = baked.provenance
            collection[HOME] = str(home)
            for name, path in kept.items():
                if name != path.name:  # the usual name is taken by somebody who was deleted
                    collection[PERSON] = name
            context.scene.collection.children.link(collection)
    return collection


@contextmanager
def _volumes(baked: Baked, written: Written | None, home: Path, kept: dict[str, Path]) -> Iterator[Sequence[Path]]:
    """The files of the volumes in `home`, with `kept` beside them where the block ends well."""
    if written is None:
        with volumes.written(baked.grids, home, kept) as files:
            yield files
        return
    here = written.home == home
    copies = {} if here else {path.name: path for path in written.files}
    with volumes.written(baked.grids, home, {**kept, **copies}, which=[]):
        yield written.files if here else [home / name for name in copies]


@contextmanager
def _nothing_left_on_failure() -> Iterator[None]:
    """When the block fails, remove every datablock made in it."""
    before = {kind: set(getattr(bpy.data, kind)) for kind in _KINDS}
    try:
        yield
    except BaseException:
        new = [thing for kind in _KINDS for thing in getattr(bpy.data, kind) if thing not in before[kind]]
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
    body[BODY_MARK] = True
    body.hide_render = True
    body.hide_viewport = True
    return body


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
    """A Volume object for each file, in `collection`, at rest where position [K, 3] and rotation [K, 3, 3] (z up) say.

    Parented to the armature, with an Armature constraint of one target per non-zero weight [K, 24] and preserve volume
    off: the evaluated matrix is A (sum_j w_j G_j) [rotation | position], with the armature object's matrix A and SMPL's
    skinning transforms G_j. It shears where joints bend, as linear blending does. Turns off the viewports' relationship
    lines, of which there would be some thousand.
    """
    hide_relationship_lines()
    quaternions = matrix_to_quaternion(rotation)
    objects = []
    for k, path in enumerate(files):
        label = f"{name}_prim_{k:04d}"
        volume = bpy.data.volumes.new(label)
        volume.filepath = stored_path(path)
        volume.render.space = "WORLD"
        volume.materials.append(material)
        primitive = bpy.data.objects.new(label, volume)
        primitive.parent = armature
        primitive.matrix_parent_inverse = Matrix.Identity(4)
        primitive.rotation_mode = "QUATERNION"
        primitive.location = position[k]
        primitive.rotation_quaternion = quaternions[k]
        constraint = primitive.constraints.new("ARMATURE")
        constraint.use_deform_preserve_volume = False
        for joint in np.flatnonzero(weights[k]):
            target = constraint.targets.new()
            target.target = armature
            target.subtarget = JOINT_NAMES[joint]
            target.weight = weights[k, joint]
        collection.objects.link(primitive)
        objects.append(primitive)
    return objects


def hide_relationship_lines() -> None:
    """Turn the overlay off in the 3D viewports of all workspaces; Overlays > Relationship Lines shows them again."""
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type == "VIEW_3D":
                    space.overlay.show_relationship_lines = False


def stand_beside_others(context: bpy.types.Context, collection: bpy.types.Collection) -> None:
    """Move a person who has just been built along the world's x axis, as little as is needed to stand free.

    Looks at where the bones of the scene's people are as posed; nobody else moves. Evaluates the scene where somebody
    else is in it. Raises ValueError as `armature_of` does.
    """
    armature = armature_of(collection)
    others = [
        thing
        for person in humans(context.scene)
        if person != collection
        for thing in person.objects
        if thing.type == "ARMATURE" and thing.data.bones
    ]
    if others:
        context.view_layer.update()
        armature.location.x += _shift(_ground(armature), [_ground(other) for other in others])


def _shift(own: NDArray[np.float64], others: list[NDArray[np.float64]]) -> float:
    """The smallest move in x, metres, after which the rectangle `own` is GAP_M or more from all others; right first."""
    places = [0.0]
    for other in others:
        places += [other[1, 0] + GAP_M - own[0, 0], other[0, 0] - GAP_M - own[1, 0]]
    free = [x for x in places if not any(_meet(own + np.array([x, 0.0]), other) for other in others)]
    return min(free, key=lambda x: (round(abs(x), 6), x < 0))  # beyond the outermost there is always room


def _meet(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Whether two rectangles are nearer than GAP_M in x while they overlap in y."""
    gap = np.array([GAP_M - 1e-6, 0.0])
    return bool(((one[0] < other[1] + gap) & (other[0] < one[1] + gap)).all())


def _ground(armature: bpy.types.Object) -> NDArray[np.float64]:
    """Lowest and highest x and y in the world [2, 2] of the bones as posed, with flesh around them."""
    to_world = np.array(armature.matrix_world)
    bones = [(bone.head, bone.tail) for bone in armature.pose.bones]
    ends = np.array(bones, np.float64).reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
    return np.array([ends.min(0)[:2] - _FLESH_M, ends.max(0)[:2] + _FLESH_M])
