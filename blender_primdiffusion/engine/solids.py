"""Solid objects in the picture: meshes and other surfaces of the dependency graph as coloured triangles."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.regular_files import remove_file
from ..files.whole_files import replacing
from ..scene.convention import points_to_backend
from ..scene.place import is_solid

UNRELATED_TYPES = frozenset({"ARMATURE", "CAMERA", "VOLUME", "POINTCLOUD", "LIGHT", "LIGHT_PROBE", "SPEAKER"})
"""Types of objects that are no solids; their children report changes of their own."""
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


def scene_solids(
    depsgraph: bpy.types.Depsgraph, everything_holdout: bool, space: bpy.types.SpaceView3D | None = None
) -> SceneSolids:
    """Visible meshes, curves, surfaces, texts, metaballs and their instances, except the bodies of humans.

    A triangle has its material's base colour (see `base_colour`), or without a material the object's. Curves and the
    like are tessellated by Blender. `everything_holdout` makes all triangles cut holes. Raises ValueError for an object
    whose corners hold NaN.
    """
    parts = list(_parts(depsgraph, space))
    if not parts:
        return SceneSolids(np.zeros((0, 3, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, bool))
    corners, colour, holdout = (np.concatenate(column) for column in zip(*parts, strict=True))
    return SceneSolids(corners, colour, holdout | everything_holdout)


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
    with replacing(path) as partial:
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
