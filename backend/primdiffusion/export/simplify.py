"""Simplify and unwrap triangle meshes; does not import torch, so that its process starts quickly."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray as Array

from primdiffusion.runtime.failures import optional_package

SEAM = 4
"""Texels between charts."""
NO_XATLAS = (
    "textured meshes need xatlas, which has no package for this Python and machine: use Python 3.11 or 3.13 on x86-64 "
    "or Apple Silicon, or export Gaussians or VDB"
)
CHART_COST = 8.0
"""Maximum cost of a chart; xatlas's default of 2 cuts noisy surfaces into many more charts."""


def simplify_and_unwrap(
    vertices: Float64[Array, "v 3"], faces: Int64[Array, "f 3"], triangles: int, texture_px: int
) -> tuple[Float64[Array, "w 3"], Int64[Array, "g 3"], Float64[Array, "g 3 2"]]:
    """Vertices, triangles and texture coordinates of the corners: `simplify`, then `unwrap`."""
    coarse = simplify(vertices, faces, triangles)
    return (*coarse, unwrap(*coarse, texture_px))


def simplify(
    vertices: Float64[Array, "v 3"], faces: Int64[Array, "f 3"], triangles: int
) -> tuple[Float64[Array, "w 3"], Int64[Array, "g 3"]]:
    """Simplify a closed mesh to at most `triangles` triangles by quadric edge collapse (libigl)."""
    if len(faces) <= triangles:
        return vertices, faces
    coarse, corners, *_ = igl.qslim(vertices, faces, triangles)
    return np.asarray(coarse), np.asarray(corners)


def unwrap(vertices: Float64[Array, "v 3"], faces: Int64[Array, "f 3"], texture_px: int) -> Float64[Array, "f 3 2"]:
    """Compute texture coordinates of every corner in non-overlapping charts (xatlas). Raises MissingPackageError."""
    xatlas = optional_package("xatlas", missing=NO_XATLAS)
    atlas, charts, packing = xatlas.Atlas(), xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_cost = CHART_COST
    packing.resolution, packing.padding, packing.bilinear = texture_px, SEAM, True
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    atlas.generate(charts, packing)
    _, corners, uv = atlas[0]
    return np.asarray(uv, np.float64)[np.asarray(corners, np.int64)]
