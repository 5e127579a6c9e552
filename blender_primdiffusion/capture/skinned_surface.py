"""Posed meshes: the space that a human takes up over its poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.camera_rig import bounding_sphere
from ..scene.convention import points_to_backend


@dataclasses.dataclass(frozen=True, eq=False)
class SkinnedSurface:
    """All points of a surface at the rig's rest, and the bones that move each.

    The backend uses the same points, so that both programs place cameras alike.
    """

    points: NDArray[np.float64]
    """[n, 3], y up, metres."""
    bones: NDArray[np.int32]
    """[n, K]."""
    weights: NDArray[np.float32]
    """[n, K]; rows sum to 1."""

    def posed(self, transforms: NDArray) -> NDArray[np.float64]:
        """The points [n, 3] moved by bones [N, 4, 4]."""
        moved = np.zeros_like(self.points)
        for bone, weight in zip(self.bones.T, self.weights.T, strict=True):
            chosen = transforms[bone, :3]
            moved += weight[:, None] * (np.einsum("nij,nj->ni", chosen[..., :3], self.points) + chosen[..., 3])
        return moved

    def outermost(self, poses: Iterable[NDArray]) -> NDArray[np.float64]:
        """Points in all poses (transforms [N, 4, 4]) that have the same box and bounding sphere as all of them."""
        poses = list(poses)
        extremes = []
        for transforms in poses:
            posed = self.posed(transforms)
            extremes += [posed[posed.argmin(0)], posed[posed.argmax(0)]]
        centre, _ = bounding_sphere(np.concatenate(extremes))
        for transforms in poses:
            posed = self.posed(transforms)
            extremes.append(posed[[np.linalg.norm(posed - centre, axis=1).argmax()]])
        return np.concatenate(extremes)


def mesh_points(meshes: Sequence[bpy.types.Object]) -> NDArray[np.float64]:
    """Vertices [V, 3] of meshes in the world, Blender's axes, without modifiers."""
    clouds = []
    for mesh in meshes:
        local = np.empty(3 * len(mesh.data.vertices), np.float32)
        mesh.data.vertices.foreach_get("co", local)
        world = np.array(mesh.matrix_world)
        clouds.append(local.reshape(-1, 3).astype(np.float64) @ world[:3, :3].T + world[:3, 3])
    return np.concatenate(clouds)


def skinned_surface(meshes: Sequence[bpy.types.Object], bones: Sequence[str]) -> SkinnedSurface:
    """The surface of meshes that follow `bones`."""
    found = [_influences(mesh, bones) for mesh in meshes]
    most = max(index.shape[1] for index, _ in found)
    return SkinnedSurface(
        points_to_backend(mesh_points(meshes)),
        np.concatenate([_widened(index, most) for index, _ in found]),
        np.concatenate([_widened(weight, most) for _, weight in found]),
    )


def _widened(values: NDArray, columns: int) -> NDArray:
    return np.pad(values, ((0, 0), (0, columns - values.shape[1])))


def _influences(mesh: bpy.types.Object, bones: Sequence[str]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Bone indices and weights [V, K] of each vertex; the root's where no bone moves it."""
    number = {name: place for place, name in enumerate(bones)}
    if mesh.parent_type == "BONE" and mesh.parent_bone in number:
        alone = np.full((len(mesh.data.vertices), 1), number[mesh.parent_bone], np.int32)
        return alone, np.ones(alone.shape, np.float32)
    bone_of = {group.index: number[group.name] for group in mesh.vertex_groups if group.name in number}
    rows = [
        [(bone_of[e.group], e.weight) for e in vertex.groups if e.group in bone_of and e.weight > 0] or [(0, 1.0)]
        for vertex in mesh.data.vertices
    ]
    index = np.zeros((len(rows), max(len(row) for row in rows)), np.int32)
    weight = np.zeros(index.shape, np.float32)
    for vertex, row in enumerate(rows):
        index[vertex, : len(row)], weight[vertex, : len(row)] = zip(*row, strict=True)
    return index, weight / weight.sum(1, keepdims=True)
