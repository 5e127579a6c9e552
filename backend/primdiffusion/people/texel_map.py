"""Map texels to points of a mesh by rasterising its texture coordinates.

Row 0 of a map is the top row of the image; v points up (see geometry/textured_mesh.py).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from scipy.ndimage import distance_transform_edt
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels


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


@njit(cache=True)
def _draw(corner_uv: np.ndarray, size: int, face: np.ndarray, barycentric: np.ndarray) -> None:
    """Write the last triangle that covers each texel centre."""
    for f in range(corner_uv.shape[0]):
        x0, y0 = corner_uv[f, 0, 0] * size, (1 - corner_uv[f, 0, 1]) * size
        x1, y1 = corner_uv[f, 1, 0] * size, (1 - corner_uv[f, 1, 1]) * size
        x2, y2 = corner_uv[f, 2, 0] * size, (1 - corner_uv[f, 2, 1]) * size
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if abs(area) < 1e-12:
            continue
        left, right = max(0, int(min(x0, x1, x2) - 0.5)), min(size - 1, int(max(x0, x1, x2)))
        top, bottom = max(0, int(min(y0, y1, y2) - 0.5)), min(size - 1, int(max(y0, y1, y2)))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column + 0.5, row + 0.5
                b = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / area
                c = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / area
                a = 1 - b - c
                if a >= -1e-6 and b >= -1e-6 and c >= -1e-6:
                    face[row, column] = f
                    barycentric[row, column, 0] = a
                    barycentric[row, column, 1] = b
                    barycentric[row, column, 2] = c


def texel_map(corner_uv: Float[np.ndarray, "F 3 2"], size: int) -> TexelMap:
    """Rasterise texture coordinates at `size` x `size` texels.

    Raises:
        ValueError: no texel's centre is inside a triangle.
    """
    face = np.full((size, size), -1, np.int32)
    barycentric = np.zeros((size, size, 3), np.float32)
    _draw(np.ascontiguousarray(corner_uv, np.float64), size, face, barycentric)
    inside = face >= 0
    if not inside.any():
        raise ValueError(f"no texel of {size} x {size} is covered: the mesh has no texture coordinates")
    nearest = np.asarray(distance_transform_edt(~inside, return_distances=False, return_indices=True))
    return TexelMap(face[tuple(nearest)], barycentric[tuple(nearest)], inside)


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
