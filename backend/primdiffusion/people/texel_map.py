"""Map texels to points of a mesh by rasterising its texture coordinates.

Row 0 of a map is the top row of the image; v points up (see geometry/textured_mesh.py).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels

from primdiffusion.raster.uv_atlas import rasterise_uv


@dataclasses.dataclass(frozen=True, eq=False)
class TexelMap:
    """The mesh point of each texel; texels between islands map to the nearest one, so that seams do not bleed."""

    face: Int[np.ndarray, "H W"]
    barycentric: Float[np.ndarray, "H W 3"]
    """Clamped to the triangle for texels outside every island."""
    inside: np.ndarray
    """[H, W] bool: the texel's centre is inside a triangle."""

    def sample(self, per_vertex: Float[np.ndarray, "V C"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "H W C"]:
        """Interpolate a vertex quantity at each texel, float64."""
        corners = per_vertex[faces[self.face]]
        return np.einsum("hwk,hwkc->hwc", self.barycentric, corners)


def texel_map(corner_uv: Float[np.ndarray, "F 3 2"], size: int) -> TexelMap:
    """Rasterise texture coordinates at `size` x `size` texels.

    Raises:
        ValueError: no texel's centre is inside a triangle.
    """
    raster = rasterise_uv(np.asarray(corner_uv, np.float64) * (1, -1) + (0, 1), size, size)
    inside = raster.covered
    if not inside.any():
        raise ValueError(f"no texel of {size} x {size} is covered: the mesh has no texture coordinates")
    nearest = np.asarray(distance_transform_edt(~inside, return_distances=False, return_indices=True))
    return TexelMap(raster.face[tuple(nearest)], raster.barycentric[tuple(nearest)].astype(np.float32), inside)


def connected_faces(faces: Int[np.ndarray, "F 3"], vertex_count: int) -> Int[np.ndarray, " F"]:
    """Index of each face's connected component, largest first."""
    label = connected_component_labels(faces_to_edges(faces), vertex_count)[faces[:, 0]]
    order = np.argsort(-np.bincount(label), kind="stable")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    return rank[label]


def uv_islands(corner_uv: Float[np.ndarray, "F 3 2"]) -> Int[np.ndarray, " F"]:
    """Index of each face's UV island, largest first."""
    keys = np.rint(corner_uv.reshape(-1, 2) * 1e5).astype(np.int64)
    unique, index = np.unique(keys, axis=0, return_inverse=True)
    return connected_faces(index.reshape(-1, 3), len(unique))
