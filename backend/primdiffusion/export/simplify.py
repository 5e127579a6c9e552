"""Triangle meshes made coarser and unwrapped; imports no torch, so that a process for it starts at once."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray as Array

SEAM = 4
"""Texels between charts."""
CHART_COST = 8.0
"""xatlas's largest cost of a chart: its 2 cuts a noisy surface into many more."""


class NoUnwrapping(ValueError):
    """This Python lacks what unwraps meshes; the message says what to do."""


def simplified(
    vertices: Float64[Array, "v 3"], faces: Int64[Array, "f 3"], triangles: int
) -> tuple[Float64[Array, "w 3"], Int64[Array, "g 3"]]:
    """A closed mesh with at most `triangles` triangles, by quadric edge collapses (libigl)."""
    if len(faces) <= triangles:
        return vertices, faces
    import igl  # slow to load

    coarse, corners, *_ = igl.qslim(vertices, faces, triangles)
    return np.asarray(coarse), np.asarray(corners)


def unwrapped(vertices: Float64[Array, "v 3"], faces: Int64[Array, "f 3"], texture_px: int) -> Float64[Array, "f 3 2"]:
    """Texture coordinates of every corner, in charts that do not overlap (xatlas). Raises NoUnwrapping."""
    try:
        import xatlas
    except ModuleNotFoundError as error:  # it has no package for Python 3.14 or Linux on ARM
        raise NoUnwrapping(
            "a textured mesh cannot be made here: xatlas, which unwraps it, has no package for this Python and "
            "machine; use Blender with Python 3.11 or 3.13 on x86-64 or Apple Silicon, or export as Gaussians or VDB"
        ) from error

    atlas, charts, packing = xatlas.Atlas(), xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_cost = CHART_COST
    packing.resolution, packing.padding, packing.bilinear = texture_px, SEAM, True
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    atlas.generate(charts, packing)
    _, corners, uv = atlas[0]
    return np.asarray(uv, np.float64)[np.asarray(corners, np.int64)]
