"""Rasterise the UV square to surface points: row = v * H, column = u * W, texel centres at +0.5 (SPEC 2)."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array


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


def rasterise_uv(corner_uv: Float[Array, "f 3 2"], height: int, width: int) -> UvRaster:
    """Rasterise the charts into height x width texels; where charts overlap, the later face wins.

    UV faces without area are skipped. Raises ValueError on coordinates that are not finite.
    """
    corner_uv = np.asarray(corner_uv, dtype=np.float64)
    if not np.isfinite(corner_uv).all():
        raise ValueError("the UV coordinates hold NaN or infinite values: export the mesh's UV map again")
    face = np.full((height, width), -1, dtype=np.int64)
    barycentric = np.zeros((height, width, 3))
    _draw(corner_uv * (width, height), face, barycentric)
    return UvRaster(face, barycentric)


@numba.njit(cache=True)
def _draw(corners, face, barycentric):  # pragma: no cover (compiled)
    height, width = face.shape
    for f in range(corners.shape[0]):
        (ax, ay), (bx, by), (cx, cy) = corners[f]
        twice_area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(twice_area) < 1e-12:
            continue
        x_first = max(int(np.ceil(min(ax, bx, cx) - 0.5)), 0)
        x_last = min(int(np.floor(max(ax, bx, cx) - 0.5)), width - 1)
        y_first = max(int(np.ceil(min(ay, by, cy) - 0.5)), 0)
        y_last = min(int(np.floor(max(ay, by, cy) - 0.5)), height - 1)
        for row in range(y_first, y_last + 1):
            for column in range(x_first, x_last + 1):
                x, y = column + 0.5 - ax, row + 0.5 - ay
                wb = (x * (cy - ay) - y * (cx - ax)) / twice_area
                wc = ((bx - ax) * y - (by - ay) * x) / twice_area
                # Texels exactly on an edge belong to both faces: a gap between them would be worse.
                if wb >= -1e-9 and wc >= -1e-9 and wb + wc <= 1 + 1e-9:
                    face[row, column] = f
                    barycentric[row, column, 0] = 1 - wb - wc
                    barycentric[row, column, 1] = wb
                    barycentric[row, column, 2] = wc


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
