"""Triangles of evaluated objects."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

SOLID_TYPES = frozenset({"MESH", "CURVE", "SURFACE", "FONT", "META"})


def triangles_of(obj: bpy.types.Object) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Vertices [V, 3] in the object's space, triangles [F, 3] and their material slots [F], of one of SOLID_TYPES."""
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
