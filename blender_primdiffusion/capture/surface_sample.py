"""Some of the points of skinned meshes, for the room that a person takes up in a pose without asking Blender."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import bpy
import numpy as np
from numpy.typing import NDArray

from ..scene.convention import points_to_backend
from .body import skin

_COUNT = 3000
_DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceSample:
    """Points of a surface at the rig's rest."""

    points: NDArray[np.float64]
    """[n, 3], y up, metres."""
    weights: NDArray[np.float64]
    """Of the rig's bones [n, N]; rows sum to 1."""

    def outermost(self, transforms: NDArray) -> NDArray[np.float64]:
        """The points [26, 3] that are furthest out along the axes and diagonals once the bones [N, 4, 4] moved them."""
        posed = skin(self.points, self.weights, transforms)
        return posed[(posed @ _DIRECTIONS.T).argmax(0)]


def mesh_points(meshes: Sequence[bpy.types.Object]) -> NDArray[np.float64]:
    """Vertices [V, 3] of meshes in the world, Blender's axes, without modifiers."""
    clouds = []
    for mesh in meshes:
        local = np.empty(3 * len(mesh.data.vertices), np.float32)
        mesh.data.vertices.foreach_get("co", local)
        world = np.array(mesh.matrix_world)
        clouds.append(local.reshape(-1, 3).astype(np.float64) @ world[:3, :3].T + world[:3, 3])
    return np.concatenate(clouds)


def sample_surface(meshes: Sequence[bpy.types.Object], bones: Sequence[str]) -> SurfaceSample:
    """Evenly chosen vertices, and the outermost ones at rest, of meshes that follow `bones`."""
    total = sum(len(mesh.data.vertices) for mesh in meshes)
    step = max(1, total // _COUNT)
    points, weights = [], []
    for mesh in meshes:
        cloud = mesh_points([mesh])
        chosen = np.union1d(np.arange(0, len(cloud), step), (cloud @ _DIRECTIONS.T).argmax(0))
        points.append(points_to_backend(cloud[chosen]))
        weights.append(_bone_weights(mesh, chosen, bones))
    return SurfaceSample(np.concatenate(points), np.concatenate(weights))


def _bone_weights(mesh: bpy.types.Object, chosen: NDArray, bones: Sequence[str]) -> NDArray[np.float64]:
    place = {name: number for number, name in enumerate(bones)}
    column = {group.index: place[group.name] for group in mesh.vertex_groups if group.name in place}
    weights = np.zeros((len(chosen), len(bones)))
    if mesh.parent_type == "BONE" and mesh.parent_bone in place:
        weights[:, place[mesh.parent_bone]] = 1
        return weights
    for row, vertex in enumerate(chosen):
        for element in mesh.data.vertices[int(vertex)].groups:
            if element.group in column:
                weights[row, column[element.group]] += element.weight
    sums = weights.sum(1, keepdims=True)
    weights[sums[:, 0] == 0, 0] = 1  # no bone moves it: it stays with the root
    return weights / np.where(sums == 0, 1, sums)
