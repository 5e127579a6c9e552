"""Rasterise the UV square to surface points: row = v * H, column = u * W, texel centres at +0.5 (SPEC 2)."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.ndimage import distance_transform_edt

from primdiffusion.raster.z_buffer import barycentrics, z_buffer

EDGE_SLACK = 1e-9
"""Slack in barycentric coordinates: a gap between two faces would be worse than a texel of both."""


@dataclasses.dataclass(frozen=True)
class UvRaster:
    """The surface point of each texel."""

    face: Int[Array, "h w"]
    """Index of the face, -1 where no chart covers the texel's centre."""
    barycentric: Float[Array, "h w 3"]
    """Barycentric coordinates on that face; zero if there is none."""

    @property
    def covered(self) -> Array:
        """[h, w] bool: texels whose centre lies in a chart."""
        return self.face >= 0

    def every(self, stride: int, offset: int) -> UvRaster:
        """The raster with only the rows and columns offset, offset + stride, ..."""
        return UvRaster(self.face[offset::stride, offset::stride], self.barycentric[offset::stride, offset::stride])

    def filled(self) -> UvRaster:
        """The raster in which a texel outside of every chart has the surface point of the nearest covered texel.

        Raises ValueError if no texel is covered.
        """
        if not self.covered.any():
            size = " x ".join(map(str, self.face.shape))
            raise ValueError(f"no texel of {size} is covered: the mesh has no texture coordinates")
        nearest = np.asarray(distance_transform_edt(~self.covered, return_distances=False, return_indices=True))
        return UvRaster(self.face[tuple(nearest)], self.barycentric[tuple(nearest)])


def rasterise_uv(corner_uv: Float[Array, "f 3 2"], height: int, width: int) -> UvRaster:
    """Rasterise the charts into height x width texels; where charts overlap, the later face wins.

    Texel centres on an edge belong to both of its faces. UV faces without area are skipped. Raises ValueError on
    coordinates that are not finite.
    """
    corner_uv = np.asarray(corner_uv, dtype=np.float64)
    if not np.isfinite(corner_uv).all():
        raise ValueError("the UV coordinates hold NaN or infinite values: export the mesh's UV map again")
    points = np.zeros((3 * len(corner_uv), 4))  # all at depth 0, where the z-buffer keeps the face drawn first
    points[:, :2] = (corner_uv * (width, height)).reshape(-1, 2)
    points[:, 2] = 1
    faces = np.ascontiguousarray(np.arange(len(points), dtype=np.int32).reshape(-1, 3)[::-1])
    found = z_buffer(points, faces, height, width, (0, 0), parallel=True, slack=EDGE_SLACK).triangle
    barycentric = barycentrics(points, faces, found, True, np.float64)
    return UvRaster(np.where(found < 0, -1, len(faces) - 1 - found).astype(np.int64), barycentric)


def closest_in_uv(
    corner_uv: Float[Array, "f 3 2"], uv_faces: Int[Array, "f 3"], points: Float[Array, "n 2"]
) -> tuple[Int[Array, "n"], Float[Array, "n 3"]]:
    """Face and barycentric coordinates of the chart point nearest to each point; the points lie outside every chart.

    The nearest point lies on the outline of a chart, so only edges of a single face are searched.
    """
    corner_uv = np.asarray(corner_uv, dtype=np.float64)
    owner = np.tile(np.arange(len(uv_faces)), 3)
    first = np.repeat(np.arange(3), len(uv_faces))
    second = (first + 1) % 3
    edges = np.sort(np.stack([uv_faces[owner, first], uv_faces[owner, second]], -1), axis=-1)
    _, index, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    outline = np.flatnonzero(count[index.reshape(-1)] == 1)
    if not len(outline):
        raise ValueError("the UV map has no boundary edges: give the body a UV map with open charts")
    owner, first, second = owner[outline], first[outline], second[outline]
    start, along = corner_uv[owner, first], corner_uv[owner, second] - corner_uv[owner, first]
    length_squared = np.maximum((along**2).sum(-1), 1e-30)
    face, barycentric = np.empty(len(points), dtype=np.int64), np.zeros((len(points), 3))
    for n, point in enumerate(points):
        fraction = np.clip(((point - start) * along).sum(-1) / length_squared, 0, 1)
        nearest = ((start + fraction[:, None] * along - point) ** 2).sum(-1).argmin()
        face[n] = owner[nearest]
        barycentric[n, first[nearest]] = 1 - fraction[nearest]
        barycentric[n, second[nearest]] += fraction[nearest]
    return face, barycentric


@dataclasses.dataclass(frozen=True, eq=False)
class TexelMap:
    """The mesh point of each texel of an image, whose row 0 is v = 1.

    Texels between islands map to the nearest one, so that seams do not bleed.
    """

    face: Int[Array, "H W"]
    barycentric: Float[Array, "H W 3"]
    """Clamped to the triangle for texels outside every island."""
    inside: Array
    """[H, W] bool: the texel's centre is inside a triangle."""

    def sample(self, per_vertex: Float[Array, "V C"], faces: Int[Array, "F 3"]) -> Float[Array, "H W C"]:
        """Interpolate a vertex quantity at each texel, float64."""
        corners = per_vertex[faces[self.face]]
        return np.einsum("hwk,hwkc->hwc", self.barycentric, corners)


def texel_map(corner_uv: Float[Array, "F 3 2"], size: int) -> TexelMap:
    """Rasterise texture coordinates at `size` x `size` texels.

    Raises:
        ValueError: no texel's centre is inside a triangle.
    """
    raster = rasterise_uv(np.asarray(corner_uv, np.float64) * (1, -1) + (0, 1), size, size)
    filled = raster.filled()
    return TexelMap(filled.face, filled.barycentric.astype(np.float32), raster.covered)
