"""Extract the outer surface of a human: an isosurface of density, without hidden cavities."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import igl
import numpy as np
import trimesh
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray as Array
from scipy import ndimage

from primdiffusion.render.merge import Merged

LEVEL = 12.0
"""Isosurface density, 1/m: gives mesh and marched image silhouettes of equal area. It is low because grazing rays are
long."""
SMALLEST_PIECE = 5e-5
"""Volume below which a disconnected piece is dropped, cubic metres."""
GAP = 0.012
"""Openings narrower than this are closed before cavities are filled, metres."""
_MARGIN = 2
"""Empty points around the grid, so that gaps are closed at its sides too."""
THIN = "this human is nowhere dense enough to have a surface: generate it again"


class OuterSurface(NamedTuple):
    """Closed triangles, counter-clockwise seen from outside."""

    vertices: Float64[Array, "v 3"]
    """Metres."""
    faces: Int64[Array, "f 3"]


def outside_surface(grid: Merged, on_wait: Callable[[], None] = lambda: None) -> OuterSurface:
    """Extract the outer surface by marching cubes (libigl); cavities are filled, small pieces dropped.

    `on_wait` is called regularly; exceptions it raises cancel. Raises ValueError.
    """
    density = np.pad(grid.density, _MARGIN)
    solid = filled(density > LEVEL, grid.voxel)
    if not solid.any():
        raise ValueError(THIN)
    on_wait()
    values = np.where(density > LEVEL, density, 2 * LEVEL)  # cavities and closed gaps count as full
    values = np.where(solid, np.minimum(values, 2 * LEVEL), np.minimum(density, LEVEL * 0.999))
    corners, cubes = _cubes_across(solid)
    places = grid.origin + grid.voxel * (np.stack(np.unravel_index(corners, solid.shape), -1) - _MARGIN)
    on_wait()
    vertices, faces, _ = igl.marching_cubes(values.ravel()[corners].astype(np.float64), places, cubes, LEVEL)
    return _large_pieces(np.asarray(vertices), np.asarray(faces)[:, ::-1])


def filled(solid: Bool[Array, "x y z"], spacing: float) -> Bool[Array, "x y z"]:
    """Fill cavities, including those with openings narrower than GAP."""
    closed = np.asarray(ndimage.binary_closing(solid, iterations=max(round(GAP / 2 / spacing), 1)))
    inside = np.asarray(ndimage.binary_fill_holes(closed))
    return solid | (inside & np.logical_not(closed))  # gaps that only the closing filled stay open


def depth_below(grid: Merged, points: Float64[Array, "n 3"]) -> Float64[Array, "n"]:
    """Depth of points below the outer surface, metres, accurate to a voxel; 0 outside."""
    solid = filled(np.pad(grid.density, _MARGIN) > LEVEL, grid.voxel)
    depth = np.asarray(ndimage.distance_transform_edt(solid)) * grid.voxel
    index = np.rint((points - grid.origin) / grid.voxel).astype(np.int64) + _MARGIN
    return depth[tuple(index.clip(0, np.array(depth.shape) - 1).T)]


def _cubes_across(solid: Array) -> tuple[Int64[Array, "n"], Int64[Array, "c 8"]]:
    """Flat grid indices of the corners of cubes that the surface crosses, and the cubes in libigl's corner order."""
    inner = tuple(size - 1 for size in solid.shape)
    count = np.zeros(inner, np.int8)
    offsets = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    for x, y, z in offsets:
        count += solid[x : x + inner[0], y : y + inner[1], z : z + inner[2]]
    cube = np.stack(np.nonzero((count > 0) & (count < 8)), -1)
    flat = np.stack([np.ravel_multi_index(tuple((cube + offset).T), solid.shape) for offset in offsets], -1)
    corners, cubes = np.unique(flat, return_inverse=True)
    return corners, cubes.reshape(flat.shape).astype(np.int64)


def _large_pieces(vertices: Array, faces: Array) -> OuterSurface:
    """Drop pieces smaller than SMALLEST_PIECE, and cavities, whose volume is negative."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    piece = trimesh.graph.connected_component_labels(mesh.edges, len(vertices))[faces[:, 0]]
    volume = np.bincount(piece, np.linalg.det(mesh.triangles) / 6)
    mesh.update_faces(volume[piece] >= SMALLEST_PIECE)
    if not len(mesh.faces):
        raise ValueError(THIN)
    mesh.remove_unreferenced_vertices()
    return OuterSurface(np.array(mesh.vertices), np.array(mesh.faces))
