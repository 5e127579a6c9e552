"""Cameras that stand within a person see the inside of a mesh: found before anything is rendered."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree
from numpy.typing import NDArray

from ..formats.camera_rig import View
from ..scene.convention import points_to_blender

TOUCHING_M = 0.02
"""Nearer than this to a surface a camera counts as inside."""
_DIRECTIONS = [
    Vector((x, y, z)).normalized() for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z
]


def cameras_inside(
    things: Sequence[bpy.types.Object], depsgraph: bpy.types.Depsgraph, views: Sequence[View]
) -> list[int]:
    """Numbers of the views that stand in or at the meshes `things`, as they are posed.

    Inside is where most rays first meet the back of a face, so open clothes do no harm.
    """
    meshes = [_world_mesh(thing, depsgraph) for thing in things]
    points = np.concatenate([points for points, _ in meshes])
    low, high = points.min(0) - TOUCHING_M, points.max(0) + TOUCHING_M
    positions = [points_to_blender(view.position) for view in views]
    near = [i for i, at in enumerate(positions) if ((low <= at) & (at <= high)).all()]
    if not near:
        return []
    trees = [BVHTree.FromPolygons(points.tolist(), faces) for points, faces in meshes]
    return [i for i in near if _is_inside(trees, Vector(positions[i]))]


def _is_inside(trees: list[BVHTree], at: Vector) -> bool:
    if any(
        distance is not None and distance < TOUCHING_M for *_, distance in (tree.find_nearest(at) for tree in trees)
    ):
        return True
    behind = 0
    for direction in _DIRECTIONS:
        hits = [tree.ray_cast(at, direction) for tree in trees]
        hits = [(distance, normal) for _, normal, _, distance in hits if distance is not None]
        if hits:
            _, normal = min(hits, key=lambda hit: hit[0])
            behind += normal.dot(direction) > 0
    return behind > len(_DIRECTIONS) / 2


def _world_mesh(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[NDArray[np.float64], list[tuple]]:
    evaluated = thing.evaluated_get(depsgraph)
    mesh = evaluated.to_mesh()
    try:
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        world = np.array(evaluated.matrix_world, np.float64)
        faces = [tuple(polygon.vertices) for polygon in mesh.polygons]
        return points.reshape(-1, 3).astype(np.float64) @ world[:3, :3].T + world[:3, 3], faces
    finally:
        evaluated.to_mesh_clear()
