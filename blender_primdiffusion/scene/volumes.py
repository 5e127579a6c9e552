"""Primitives as VDB files: the marcher's window baked into density, a small file each, named by its content."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from .human_file import VOXELS

WINDOW_EXPONENT = 8
PAD = 1
"""Empty voxels around the box: without them Cycles cuts half a voxel off every side."""


class VolumeWriteError(OSError):
    """VDB files could not be written; nothing was left behind."""


@dataclasses.dataclass(frozen=True)
class Grids:
    """Voxels of all primitives in the index order of VDB, x along T, y along B, z along N, padded."""

    density: NDArray[np.float16]
    """Opacity per metre with the window [K, X, Y, Z]; zero in the padding."""
    colour: NDArray[np.float16]
    """Linear RGB [K, X, Y, Z, 3]; the padding repeats the edge, so that interpolation does not darken the rim."""
    half_extent: NDArray[np.float64]
    """Half sides in metres [K, 3]."""


def window() -> NDArray[np.float64]:
    """exp(-8 sum |y|^8) at the voxel centres y = -1 + 2 i / 7 (SPEC 4), [8, 8, 8]; symmetric in its axes."""
    axis = np.exp(-8.0 * np.abs(np.linspace(-1.0, 1.0, VOXELS)) ** WINDOW_EXPONENT)
    return axis[:, None, None] * axis[None, :, None] * axis[None, None, :]


def bake(density: NDArray, rgb: NDArray, half_extent: NDArray) -> Grids:
    """Voxels as the files hold them, from density [K, D, H, W] and rgb [K, D, H, W, 3] (D, H, W along N, B, T)."""
    pad = [(0, 0)] + [(PAD, PAD)] * 3
    windowed = np.pad(np.asarray(density, np.float64) * window(), pad).transpose(0, 3, 2, 1)
    colour = np.pad(rgb, [*pad, (0, 0)], mode="edge").transpose(0, 3, 2, 1, 4)
    largest = float(np.finfo(np.float16).max)
    return Grids(
        np.clip(windowed, 0, largest).astype(np.float16), colour.astype(np.float16), np.asarray(half_extent, np.float64)
    )


def index_to_local(half_extent: NDArray, blender_version: tuple[int, ...]) -> NDArray[np.float64]:
    """VDB's row-vector index-to-object transform [4, 4] of a padded box with half sides [3] in metres.

    Voxel i of the unpadded eight has its centre at half_extent * (-1 + 2 i / 7). Cycles before 5.0 draws every voxel
    half a voxel too high on each axis, so its files are shifted down.
    """
    step = 2.0 * np.asarray(half_extent) / (VOXELS - 1)
    shift = -0.5 * step if blender_version < (5, 0) else 0.0
    transform = np.diag([*step, 1.0])
    transform[3, :3] = -half_extent - PAD * step + shift
    return transform


def file_name(grids: Grids, k: int, blender_version: tuple[int, ...]) -> str:
    """prim_<k>_<hash>.vdb: Blender caches grids by path, so other content must have another name."""
    digest = hashlib.sha256()
    digest.update(index_to_local(grids.half_extent[k], blender_version).tobytes())
    digest.update(np.ascontiguousarray(grids.density[k]).tobytes())
    digest.update(np.ascontiguousarray(grids.colour[k]).tobytes())
    return f"prim_{k:04d}_{digest.hexdigest()[:12]}.vdb"


@contextmanager
def written(grids: Grids, folder: Path, keep: Sequence[Path] = ()) -> Iterator[list[Path]]:
    """Write the VDBs in a hidden part of `folder`, and move them into it when the block ends well.

    Files in `keep` are copied there too. Yields the final paths [K], which exist only after the block. When the block
    or a write fails, neither the files nor folders made for them remain. Raises VolumeWriteError when the folder cannot
    be written or the disk is full.
    """
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".writing_", dir=folder))
    except OSError as error:
        _remove_empty(folder, existing)
        raise _write_error(folder, error) from error
    published: list[Path] = []
    try:
        try:
            names = _write_files(grids, staging)
            kept = [Path(shutil.copyfile(path, staging / path.name)).name for path in keep]
        except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
            raise _write_error(folder, error) from error
        yield [folder / name for name in names]
        for name in [*names, *kept]:
            if not (folder / name).exists():
                published.append(folder / name)
            try:
                os.replace(staging / name, folder / name)
            except OSError as error:
                raise _write_error(folder, error) from error
    except BaseException:
        for path in published:
            path.unlink(missing_ok=True)
        raise
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        _remove_empty(folder, existing)


def _write_files(grids: Grids, folder: Path) -> list[str]:
    bpy.utils.expose_bundled_modules()
    import openvdb  # Blender's own, importable only after the line above

    names = []
    for k in range(len(grids.density)):
        transform = openvdb.createLinearTransform(index_to_local(grids.half_extent[k], bpy.app.version).tolist())
        density, colour = openvdb.FloatGrid(), openvdb.Vec3SGrid()
        density.name, density.gridClass = "density", openvdb.GridClass.FOG_VOLUME
        colour.name = "Cd"
        for grid, values in ((density, grids.density[k]), (colour, grids.colour[k])):
            grid.copyFromArray(np.ascontiguousarray(values, dtype=np.float32))
            grid.transform = transform
            grid.saveFloatAsHalf = True
        name = file_name(grids, k, bpy.app.version)
        openvdb.write(str(folder / name), grids=[density, colour])
        names.append(name)
    return names


def _write_error(folder: Path, error: BaseException) -> VolumeWriteError:
    return VolumeWriteError(
        f"the volumes could not be written to {str(folder)!r} ({error}); save the .blend in a folder with "
        "write permission and free space"
    )


def _remove_empty(folder: Path, existing: Path) -> None:
    """Remove `folder` and its parents below `existing`, as far as they are empty."""
    for path in (folder, *folder.parents):
        if path == existing or not path.is_dir() or any(path.iterdir()):
            return
        path.rmdir()


def humans_folder(blend_path: str | None = None) -> Path:
    """Where the people of a .blend live: `<blendname>_humans` beside it, a temporary folder while it is unsaved."""
    blend = Path(blend_path if blend_path is not None else bpy.data.filepath)
    if blend.name:
        return blend.resolve().parent / f"{blend.stem}_humans"
    return Path(bpy.app.tempdir) / "primdiffusion_humans"


def stored_path(path: Path) -> str:
    """A path as a .blend should hold it: relative (`//`) when the .blend is saved, else absolute."""
    if not bpy.data.filepath:
        return str(path)
    try:
        return bpy.path.relpath(str(path))
    except ValueError:  # another drive on Windows
        return str(path)
