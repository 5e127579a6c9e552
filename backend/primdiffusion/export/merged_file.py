"""People as one grid of voxels in a file: .npz for numpy, .vdb for renderers; z up, as Blender has it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from primdiffusion.formats.requests import VOXEL
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.merge import Merged, merge

Z_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Blender's axes from the backend's. Grids are turned before they are made: their voxels would not turn afterwards."""


class NoOpenVDB(ValueError):
    """This Python cannot write VDB files; the message says what to do."""


def upright_grid(primitives: Primitives, voxel: float = VOXEL) -> Merged:
    """All of `primitives` (y up, unbatched) in one grid that is z up. Raises as `merge`."""
    return merge(
        Primitives(
            primitives.position @ Z_UP.T,
            Z_UP @ primitives.rotation,
            primitives.half_extent,
            primitives.rgb,
            primitives.density,
        ),
        voxel,
    )


def write_grid_npz(path: Path, grid: Merged) -> None:
    """density float16 [X, Y, Z] (1/m), colour float16 [X, Y, Z, 3] (linear), origin [3] and voxel (metres)."""
    with path.open("wb") as file:  # savez would append .npz to a temporary name
        np.savez_compressed(
            file,
            density=grid.density.astype(np.float16),
            colour=grid.colour.astype(np.float16),
            origin=grid.origin,
            voxel=np.float64(grid.voxel),
        )


def check_openvdb() -> None:
    """Raises NoOpenVDB where there is no module `openvdb`."""
    try:
        import openvdb  # noqa: F401
    except ImportError as error:
        raise NoOpenVDB(
            "this Python has no module openvdb, which writes .vdb files: install it (Debian and Ubuntu: "
            "python3-openvdb; Blender brings its own), or write an .npz"
        ) from error


def write_grid_vdb(path: Path, grid: Merged) -> None:
    """Grids `density` (1/m, a fog volume) and `Cd` (linear RGB), half floats. Raises NoOpenVDB, OSError."""
    check_openvdb()
    import openvdb

    index_to_world = np.diag([grid.voxel] * 3 + [1.0])  # row vectors
    index_to_world[3, :3] = grid.origin
    transform = openvdb.createLinearTransform(index_to_world.tolist())
    density, colour = openvdb.FloatGrid(), openvdb.Vec3SGrid()
    density.name, density.gridClass = "density", openvdb.GridClass.FOG_VOLUME
    colour.name = "Cd"
    for written, values in ((density, grid.density), (colour, grid.colour)):
        written.copyFromArray(np.ascontiguousarray(values, np.float32))
        written.transform = transform
        written.saveFloatAsHalf = True
    try:
        openvdb.write(str(path), grids=[density, colour])
    except RuntimeError as error:  # also of a full disk
        raise OSError(f"{path.name} could not be written: {error}") from error
