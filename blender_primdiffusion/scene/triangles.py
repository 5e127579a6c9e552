"""Triangles of evaluated objects, and which objects are solid besides humans."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from .human import BODY_MARK
from .proxy import PROXY_MARK
from .stand_in import STAND_IN

_SOLID_TYPES = frozenset({"MESH", "CURVE", "SURFACE", "FONT", "META"})
_OF_HUMANS = (BODY_MARK, PROXY_MARK, STAND_IN)


def is_solid(obj: bpy.types.Object) -> bool:
    """Whether an object has a surface and is no part of a human."""
    return obj.type in _SOLID_TYPES and not any(mark in obj for mark in _OF_HUMANS)


def triangles_of(obj: bpy.types.Object) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
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
