"""Ordinary objects in the picture: what the dependency graph shows of meshes and the like, as coloured triangles."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..scene.convention import points_to_backend
from ..scene.human import BODY_MARK
from ..scene.proxy import PROXY_MARK
from .visible import visible_instances

SOLID_TYPES = frozenset({"MESH", "CURVE", "SURFACE", "FONT", "META"})
UNMOVED_BY_THESE = frozenset({"ARMATURE", "CAMERA", "VOLUME", "LIGHT", "LIGHT_PROBE", "SPEAKER"})
"""Objects whose own change changes no solid; what hangs on them reports a change of its own."""
_SOLID_DATA = (
    bpy.types.Mesh,
    bpy.types.Curve,
    bpy.types.MetaBall,
    bpy.types.Material,
    bpy.types.NodeTree,
    bpy.types.Collection,
    bpy.types.Scene,
)
"""What else may change solids: their data, their colours, and who is visible."""
_KEPT_FILES = 8
"""Pictures that are still waiting, of several viewports, may want older ones."""


@dataclasses.dataclass(frozen=True)
class Solids:
    """Opaque triangles in the world; backend axes, metres."""

    corners: NDArray[np.float32]
    """[F, 3, 3]: corner, axis."""
    colour: NDArray[np.float32]
    """[F, 3], linear."""
    holdout: NDArray[np.bool_]
    """[F]: cuts a hole into the picture instead of being seen."""


def scene_solids(
    depsgraph: bpy.types.Depsgraph, everything_holdout: bool, space: bpy.types.SpaceView3D | None = None
) -> Solids:
    """What is visible of meshes, curves, surfaces, texts, metaballs and their instances, except people's own bodies.

    A triangle has its material's base colour (see `base_colour`), or without a material the object's. Curves and the
    like are taken as Blender tessellates them. `everything_holdout` makes all of it cut holes. Raises ValueError for an
    object whose corners hold NaN.
    """
    parts = list(_parts(depsgraph, space))
    if not parts:
        return Solids(np.zeros((0, 3, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, bool))
    corners, colour, holdout = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Solids(corners, colour, holdout | everything_holdout)


def changed_by(depsgraph: bpy.types.Depsgraph) -> bool:
    """Whether the newest changes may concern solids; moving a camera or a pose does not."""
    return any(_concerns_solids(update.id) for update in depsgraph.updates)


def _concerns_solids(changed: bpy.types.ID) -> bool:
    if isinstance(changed, bpy.types.Object):
        return changed.type not in UNMOVED_BY_THESE
    return isinstance(changed, _SOLID_DATA)


def stored(solids: Solids, folder: Path) -> Path | None:
    """The file of these solids for the child, named by its content; None where there are none. Older files go."""
    if len(solids.corners) == 0:
        return None
    digest = hashlib.sha256()
    for values in (solids.corners, solids.colour, solids.holdout):
        digest.update(np.ascontiguousarray(values).data)
    path = folder / f"solids_{digest.hexdigest()[:16]}.npz"
    if path.exists():
        return path
    unfinished = folder / f".{path.name}"
    np.savez(unfinished, corners=solids.corners, colour=solids.colour, holdout=solids.holdout)
    os.replace(unfinished, path)
    for old in sorted(folder.glob("solids_*.npz"), key=lambda file: file.stat().st_mtime_ns)[:-_KEPT_FILES]:
        old.unlink(missing_ok=True)
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
        thing = instance.object
        of_person = BODY_MARK in thing or PROXY_MARK in thing
        if thing.type not in SOLID_TYPES or of_person or not thing.visible_camera:
            continue
        key = (thing.data.as_pointer(), thing.original.as_pointer())
        if key not in meshes:
            meshes[key] = _triangles(thing)
        local, colour = meshes[key]
        if len(local) == 0:
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        world = points_to_backend(local @ matrix[:3, :3].T + matrix[:3, 3])
        if not np.isfinite(world).all():
            raise ValueError(f"the object {thing.name!r} holds NaN or infinite numbers: repair its mesh, or hide it")
        owner = (instance.parent or thing).original
        holdout = thing.is_holdout or owner.holdout_get(view_layer=depsgraph.view_layer)
        yield world.astype(np.float32), colour, np.full(len(local), holdout)


def _triangles(thing: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Corners [F, 3, 3] in the object's space and colours [F, 3] of an evaluated object."""
    mesh = thing.data if thing.type == "MESH" else thing.to_mesh()
    if mesh is None:
        return np.zeros((0, 3, 3)), np.zeros((0, 3), np.float32)
    try:
        mesh.calc_loop_triangles()
        vertices = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.vertices.foreach_get("co", vertices.ravel())
        triangles = np.empty((len(mesh.loop_triangles), 3), np.int32)
        mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
        index = np.empty(len(triangles), np.int32)
        mesh.loop_triangles.foreach_get("material_index", index)
    finally:
        if thing.type != "MESH":
            thing.to_mesh_clear()
    colours = [
        base_colour(slot.material) if slot.material else tuple(thing.color)[:3] for slot in thing.material_slots
    ] or [tuple(thing.color)[:3]]
    palette = np.array(colours, np.float32)
    return vertices[triangles].astype(np.float64), palette[np.minimum(index, len(palette) - 1)]
