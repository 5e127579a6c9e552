"""Primitives as VDB files."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.whole_files import temporary_folder

bpy.utils.expose_bundled_modules()
import openvdb  # noqa: E402  Blender's own, importable only after the line above

VOXELS = 8
"""Voxels along a side of a primitive."""
WINDOW_EXPONENT = 8
FAINTEST = 0.05
"""Opacity per metre below which a voxel counts as empty; half a percent of alpha over a whole box."""
LEAST_WINDOW = 1e-3
"""Window below which a voxel counts as empty at any density: the outermost, with exp(-8). With them every grid would
reach over leaf nodes of eight voxels on each axis, and files, memory and Cycles would take four times as much."""
PAD = 1
"""Empty voxels around those that are not: Cycles draws a grid only half a voxel beyond its last one."""
_ALMOST_EMPTY = 1e-4
"""Opacity per metre of the one voxel of an empty primitive: Cycles complains of grids without any value."""
_ALL_ACTIVE = -1.0
"""A tolerance below every difference from the background, so that zeros become active voxels too."""


@dataclasses.dataclass(frozen=True)
class Grids:
    """Voxels of all primitives in VDB's index order: x along T, y along B, z along N; padded by PAD on all sides."""

    density: NDArray[np.float16]
    """Opacity per metre with the window [K, X, Y, Z]; zero where empty and in the padding."""
    colour: NDArray[np.float16]
    """Linear RGB [K, X, Y, Z, 3]; the padding repeats the edge, so that interpolation does not darken the rim."""
    half_extent: NDArray[np.float64]
    """Half sides of the whole box in metres [K, 3]."""
    first: NDArray[np.int64]
    """First index of each axis that is written [K, 3]: the voxels that are not empty, and PAD before them."""
    last: NDArray[np.int64]
    """Last index that is written, inclusive [K, 3]."""


def window() -> NDArray[np.float64]:
    """exp(-8 sum |y|^8) at the voxel centres y = -1 + 2 i / 7 (SPEC 4), [8, 8, 8]; symmetric in its axes."""
    axis: NDArray[np.float64] = np.exp(-8.0 * np.abs(np.linspace(-1.0, 1.0, VOXELS)) ** WINDOW_EXPONENT)
    return axis[:, None, None] * axis[None, :, None] * axis[None, None, :]


def bake(density: NDArray, rgb: NDArray, half_extent: NDArray) -> Grids:
    """Voxels as the files hold them, from density [K, D, H, W] and rgb [K, D, H, W, 3] (D, H, W along N, B, T).

    A box is mostly empty outside the skin: only the part that is not gets written, so that a ray meets fewer volumes.
    """
    pad = [(0, 0)] + [(PAD, PAD)] * 3
    inside = np.where(window() < LEAST_WINDOW, 0.0, window())
    windowed = np.pad(np.asarray(density, np.float64) * inside, pad).transpose(0, 3, 2, 1)
    windowed = np.where(windowed < FAINTEST, 0.0, np.minimum(windowed, float(np.finfo(np.float16).max)))
    colour = np.pad(rgb, [*pad, (0, 0)], mode="edge").transpose(0, 3, 2, 1, 4)
    first, last = np.empty((2, len(windowed), 3), np.int64)
    for axis in range(3):
        full = (windowed > 0).any(tuple(other + 1 for other in range(3) if other != axis))
        first[:, axis] = np.argmax(full, -1) - PAD
        last[:, axis] = full.shape[-1] - 1 - np.argmax(full[:, ::-1], -1) + PAD
    empty = ~(windowed > 0).any((1, 2, 3))
    middle = VOXELS // 2
    first[empty] = last[empty] = middle
    windowed[empty, middle, middle, middle] = _ALMOST_EMPTY
    return Grids(
        windowed.astype(np.float16), colour.astype(np.float16), np.asarray(half_extent, np.float64), first, last
    )


def index_to_local(half_extent: NDArray) -> NDArray[np.float64]:
    """VDB's row-vector index-to-object transform [4, 4] of a box with half sides [3] in metres.

    Voxel i of the eight (the padding has -1 and 8) has its centre at half_extent * (-1 + 2 i / 7).
    """
    step = 2.0 * np.asarray(half_extent) / (VOXELS - 1)
    transform = np.diag([*step, 1.0])
    transform[3, :3] = -half_extent
    return transform


def write_volume(grids: Grids, k: int, path: Path) -> None:
    """Write a primitive's volume to `path`, where it appears whole or not at all.

    Raises OSError, and RuntimeError when the disk is full.
    """
    part = tuple(slice(first, last + 1) for first, last in zip(grids.first[k], grids.last[k], strict=True))
    with temporary_folder(path.parent / "volume") as hidden:
        write_vdb(
            hidden / path.name,
            grids.density[k][part],
            grids.colour[k][part],
            index_to_local(grids.half_extent[k]),
            tuple((grids.first[k] - PAD).tolist()),
            _ALL_ACTIVE,
        )
        os.replace(hidden / path.name, path)


def write_vdb(
    path: Path,
    density: NDArray,
    colour: NDArray,
    index_to_object: NDArray,
    start: tuple[int, int, int] = (0, 0, 0),
    tolerance: float = 0.0,
) -> None:
    """Write `density` [X, Y, Z] and `Cd` [X, Y, Z, 3] as half floats, the first voxel at index `start`.

    Voxels no further than `tolerance` from zero are left out. Raises OSError, and RuntimeError when the disk is full.
    """
    transform = openvdb.createLinearTransform(index_to_object.tolist())
    fog, cd = openvdb.FloatGrid(), openvdb.Vec3SGrid()
    fog.name, fog.gridClass = "density", openvdb.GridClass.FOG_VOLUME
    cd.name = "Cd"
    for grid, values, near_zero in ((fog, density, tolerance), (cd, colour, (tolerance,) * 3)):
        grid.copyFromArray(np.ascontiguousarray(values, np.float32), ijk=start, tolerance=near_zero)
        grid.transform = transform
        grid.saveFloatAsHalf = True
    openvdb.write(str(path), grids=[fog, cd])
