"""Write humans as one voxel grid, z up as in Blender: .npz for numpy, .vdb for renderers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from primdiffusion.files.arrays import write_deflated
from primdiffusion.formats.requests import VOXEL
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.merge import Merged, merge
from primdiffusion.runtime.failures import optional_package

Z_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Blender's axes from the backend's; applied before voxelising, because a grid cannot be rotated without resampling."""
_NO_OPENVDB = (
    "writing .vdb needs the module openvdb: install it (Debian and Ubuntu: python3-openvdb; Blender bundles its own), "
    "or write an .npz"
)


def upright_grid(primitives: Primitives, voxel: float = VOXEL) -> Merged:
    """Merge `primitives` (y up, unbatched) into one z-up grid. Raises as `merge`."""
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
    """Write density float16 [X, Y, Z] (1/m), colour float16 [X, Y, Z, 3] (linear), origin [3] and voxel (metres)."""
    arrays = {
        "density": grid.density.astype(np.float16),
        "colour": grid.colour.astype(np.float16),
        "origin": np.asarray(grid.origin),
        "voxel": np.float64(grid.voxel),
    }
    write_deflated(path, arrays)


def grid_writer(path: Path) -> Callable[[Path, Merged], None]:
    """Return the function that writes the format of a file. Raises MissingPackageError for a .vdb without openvdb."""
    if path.suffix.lower() != ".vdb":
        return write_grid_npz
    load_openvdb()
    return write_grid_vdb


def load_openvdb() -> ModuleType:
    """Return the module `openvdb`, an optional dependency. Raises MissingPackageError."""
    return optional_package("openvdb", missing=_NO_OPENVDB)


def write_grid_vdb(path: Path, grid: Merged) -> None:
    """Write the grids `density` (1/m, a fog volume) and `Cd` (linear RGB) in float16.

    Raises MissingPackageError, OSError.
    """
    openvdb = load_openvdb()
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
    except RuntimeError as error:  # raised for a full disk too
        raise OSError(f"{path.name} could not be written: {error}") from error
