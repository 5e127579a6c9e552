"""What is drawn, read from a dependency graph: humans, solid objects as coloured triangles, background and settings."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.regular_files import remove_file
from ..files.whole_files import atomic_replace
from ..formats.joints import JOINT_NAMES
from ..scene.armature import model_origin
from ..scene.blend_values import stored_numbers
from ..scene.convention import points_to_backend, transforms_to_backend
from ..scene.human import BETA_COUNT, BETAS, is_human, session_file
from ..scene.place import is_solid

SMALLEST_SCALE = 1e-4
"""Animators hide objects by scaling them to zero: below this a human is smaller than the width of a hair."""


@dataclasses.dataclass(frozen=True)
class PosedHuman:
    """A posed human as the child draws it; backend axes, metres."""

    file: Path
    object_to_world: NDArray[np.float64]
    """[3, 4]; the object's space is the body model's (see `human.ORIGIN`)."""
    joints: NDArray[np.float64]
    """Transforms of SMPL's joints from rest to pose, in the same space [24, 3, 4]."""
    betas: list[float] | None
    """The body's shape; None for the file's."""
    pelvis: NDArray[np.float64]
    """Position [3] in Blender's world."""

    def params(self) -> dict[str, object]:
        """Parameters of the child's `draw`."""
        return {
            "human": str(self.file),
            "object": self.object_to_world.tolist(),
            "joints": self.joints.tolist(),
            "betas": self.betas,
        }


@dataclasses.dataclass(frozen=True)
class SceneContent:
    """What the child's `draw` needs of the scene, without view and frame."""

    people: tuple[PosedHuman, ...]
    solids: Path | None
    background: tuple[float, float, float] | None
    """Linear; None for a transparent film."""
    shown: str
    """What is drawn of the humans: "colour", "depth", "alpha" or "boxes"."""
    step: float
    """Between samples along a ray, metres."""

    @property
    def subject(self) -> NDArray[np.float64]:
        """The middle of the humans [3] in Blender's world; the origin where there are none."""
        return np.mean([person.pelvis for person in self.people], 0) if self.people else np.zeros(3)

    def params(self) -> dict[str, Any]:
        """Parameters of the child's `draw`."""
        return {
            "people": [person.params() for person in self.people],
            "solids": str(self.solids) if self.solids else None,
            "background": list(self.background) if self.background else None,
            "view": self.shown,
            "step": self.step,
        }


def scene_content(
    depsgraph: bpy.types.Depsgraph, solids: Path | None, space: bpy.types.SpaceView3D | None = None
) -> SceneContent:
    """The scene as the dependency graph, or a viewport, shows it, with the file from `stored`.

    Raises as `posed_humans` does.
    """
    scene = depsgraph.scene
    settings = scene.primdiffusion_render
    return SceneContent(
        tuple(posed_humans(depsgraph, space)),
        solids,
        None if scene.render.film_transparent else world_colour(depsgraph),
        settings.view.lower(),
        settings.step,
    )


def world_colour(depsgraph: bpy.types.Depsgraph) -> tuple[float, float, float]:
    """The world's plain colour, linear: its Background shader's colour times strength, black without a world.

    Where colour or strength come from other nodes (a sky, a picture), the colour the world has in Solid mode.
    """
    world = getattr(depsgraph.view_layer_eval, "world_override", None) or depsgraph.scene.world
    if world is None:
        return (0.0, 0.0, 0.0)
    if world.node_tree is not None:
        output = world.node_tree.get_output_node("ALL")
        links = output.inputs["Surface"].links if output is not None else ()
        shader = links[0].from_node if links else None
        if shader is None:
            return (0.0, 0.0, 0.0)
        if shader.type == "BACKGROUND" and not any(socket.is_linked for socket in shader.inputs):
            strength = shader.inputs["Strength"].default_value
            red, green, blue = tuple(shader.inputs["Color"].default_value)[:3]
            return (red * strength, green * strength, blue * strength)
    red, green, blue = world.color
    return (red, green, blue)


def posed_humans(depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None) -> list[PosedHuman]:
    """All humans whose armature is visible, in a viewport where one is given; instances included.

    An armature represents its human, which is hidden with it and drawn wherever it is instanced, unless scaled to zero.
    Raises FileNotFoundError for a human whose file is missing, and ValueError for a shape that is not a list of numbers
    or a pose that holds NaN.
    """
    return [pose_of(armature, matrix) for armature, matrix in human_armatures(visible_instances(depsgraph, space))]


def human_armatures(
    instances: Iterable[bpy.types.DepsgraphObjectInstance],
) -> Iterator[tuple[bpy.types.Object, NDArray[np.float64]]]:
    """Of `visible_instances`, those that show a human: the evaluated armature, which is valid until the next one, and
    its world matrix [4, 4]."""
    for instance in instances:
        obj = instance.object
        if is_human(obj) and all(name in obj.data.bones for name in JOINT_NAMES):
            matrix = np.array(instance.matrix_world, np.float64)
            if not abs(np.linalg.det(matrix[:3, :3])) < SMALLEST_SCALE**3:
                yield obj, matrix


def pose_of(armature: bpy.types.Object, matrix: NDArray) -> PosedHuman:
    """A human as its armature is posed, with the object at `matrix` [4, 4]. Raises as `posed_humans` does."""
    bones = armature.pose.bones
    posed = np.array([bones[name].matrix for name in JOINT_NAMES], np.float64)
    rest = np.array([bones[name].bone.matrix_local for name in JOINT_NAMES], np.float64)
    if not (np.isfinite(posed).all() and np.isfinite(matrix).all()):
        raise ValueError(f"the armature {armature.name!r} holds NaN or infinite numbers: check its pose and drivers")
    origin = np.eye(4)
    origin[:3, 3] = model_origin(armature.data)
    return PosedHuman(
        session_file(armature.original),
        transforms_to_backend(matrix @ origin),
        transforms_to_backend(np.linalg.inv(origin) @ posed @ np.linalg.inv(rest) @ origin),
        _betas(armature),
        (matrix @ posed[0])[:3, 3],
    )


def _betas(armature: bpy.types.Object) -> list[float] | None:
    if BETAS not in armature:
        return None
    betas = stored_numbers(armature, BETAS, BETA_COUNT)
    if betas is None:
        raise ValueError(
            f"the custom property {BETAS!r} of {armature.name!r} is not a list of numbers: "
            "make it a list of ten numbers, or delete it"
        )
    return betas


UNRELATED_TYPES = frozenset({"ARMATURE", "CAMERA", "VOLUME", "POINTCLOUD", "LIGHT", "LIGHT_PROBE", "SPEAKER"})
"""Types of objects that are not solids; their children report changes of their own."""
_SOLID_DATA = (
    bpy.types.Mesh,
    bpy.types.Curve,
    bpy.types.MetaBall,
    bpy.types.Material,
    bpy.types.NodeTree,
    bpy.types.Collection,
    bpy.types.Scene,
)
"""Other data that may change solids: their geometry, their colours, and what is visible."""


@dataclasses.dataclass(frozen=True)
class SceneSolids:
    """Opaque triangles in the world; backend axes, metres."""

    corners: NDArray[np.float32]
    """[F, 3, 3]: corner, axis."""
    colour: NDArray[np.float32]
    """[F, 3], linear."""
    holdout: NDArray[np.bool_]
    """[F]: cuts a hole into the picture instead of being drawn."""


def scene_solids(depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None) -> SceneSolids:
    """Visible meshes, curves, surfaces, texts, metaballs and their instances, except the bodies of humans.

    A triangle has its material's base colour (see `base_colour`), or without a material the object's. Curves and the
    like are tessellated by Blender. Raises ValueError for an object whose corners hold NaN.
    """
    parts = list(_parts(depsgraph, space))
    if not parts:
        return SceneSolids(np.zeros((0, 3, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, bool))
    corners, colour, holdout = (np.concatenate(column) for column in zip(*parts, strict=True))
    return SceneSolids(corners, colour, holdout)


def visible_instances(
    depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None
) -> Iterator[bpy.types.DepsgraphObjectInstance]:
    """All visible objects of the dependency graph; in a viewport's local view, only those in it and their instances.

    An instance is valid until the next one is requested.
    """
    local = space is not None and space.local_view is not None
    for instance in depsgraph.object_instances:
        if not instance.show_self:
            continue
        if local and not (instance.parent or instance.object).original.local_view_get(space):
            continue
        yield instance


def changed_by(depsgraph: bpy.types.Depsgraph) -> bool:
    """Whether the newest changes may affect solids; moving a camera or posing does not."""
    return any(_concerns_solids(update.id) for update in depsgraph.updates)


def _concerns_solids(changed: bpy.types.ID) -> bool:
    if isinstance(changed, bpy.types.Object):
        return changed.type not in UNRELATED_TYPES
    return isinstance(changed, _SOLID_DATA)


def stored(solids: SceneSolids, folder: Path) -> Path | None:
    """Write solids to a file for the child, named by its content, and remove older ones; None where there are none."""
    if len(solids.corners) == 0:
        return None
    digest = hashlib.sha256()
    for values in (solids.corners, solids.colour, solids.holdout):
        digest.update(np.ascontiguousarray(values).data)
    path = folder / f"solids_{digest.hexdigest()[:16]}.npz"
    if path.exists():
        return path
    for old in list(folder.glob("solids_*.npz")):
        with contextlib.suppress(PermissionError):  # Windows removes no file that the child reads: next time
            remove_file(old, folder)
    with atomic_replace(path) as partial:
        np.savez(partial, corners=solids.corners, colour=solids.colour, holdout=solids.holdout)
    return path


def base_colour(material: bpy.types.Material) -> tuple[float, float, float]:
    """Linear RGB of a material: a Principled shader's unlinked Base Color, else the colour it has in Solid mode."""
    if material.node_tree is not None:
        for node in material.node_tree.nodes:
            if node.type == "BSDF_PRINCIPLED" and not node.inputs["Base Color"].is_linked:
                return tuple(node.inputs["Base Color"].default_value)[:3]
    return tuple(material.diffuse_color)[:3]


def _parts(
    depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None
) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
    """Corners, colours and holdout of each visible object or instance."""
    meshes: dict[object, tuple[NDArray, NDArray]] = {}
    for instance in visible_instances(depsgraph, space):
        obj = instance.object
        if not is_solid(obj) or not obj.visible_camera:
            continue
        key = (obj.data.as_pointer(), obj.original.as_pointer())
        if key not in meshes:
            meshes[key] = _triangles(obj)
        local, colour = meshes[key]
        if len(local) == 0:
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        world = points_to_backend(local @ matrix[:3, :3].T + matrix[:3, 3])
        if not np.isfinite(world).all():
            raise ValueError(f"the object {obj.name!r} holds NaN or infinite numbers: repair its mesh, or hide it")
        owner = (instance.parent or obj).original
        holdout = obj.is_holdout or owner.holdout_get(view_layer=depsgraph.view_layer)
        yield world.astype(np.float32), colour, np.full(len(local), holdout)


def _triangles(obj: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Corners [F, 3, 3] in the object's space and colours [F, 3] of an evaluated object."""
    vertices, triangles, slots = _triangles_of(obj)
    if len(triangles) == 0:
        return np.zeros((0, 3, 3)), np.zeros((0, 3), np.float32)
    colours = [
        base_colour(slot.material) if slot.material else tuple(obj.color)[:3] for slot in obj.material_slots
    ] or [tuple(obj.color)[:3]]
    palette = np.array(colours, np.float32)
    return vertices[triangles].astype(np.float64), palette[np.minimum(slots, len(palette) - 1)]


def _triangles_of(obj: bpy.types.Object) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Vertices [V, 3] in the object's space, triangles [F, 3] and their material slots [F], where `is_solid`."""
    mesh = obj.data if obj.type == "MESH" else obj.to_mesh()
    if mesh is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.int32)
    try:
        mesh.calc_loop_triangles()
        vertices = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.vertices.foreach_get("co", vertices.ravel())
        triangles = np.empty((len(mesh.loop_triangles), 3), np.int32)
        mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
        slots = np.empty(len(triangles), np.int32)
        mesh.loop_triangles.foreach_get("material_index", slots)
    finally:
        if obj.type != "MESH":
            obj.to_mesh_clear()
    return vertices, triangles, slots
