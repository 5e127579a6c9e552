"""Measures the memory that Blender itself retains for deleted VDB files: no code of the extension runs here.

    python benchmarks/extension_bare.py --rounds 20

Each round writes 1024 files like a person's (a float and a colour grid of 10^3 voxels), shows them as volumes, removes
these from the .blend, empties the grid cache and deletes the files. The names are new in every round, as a person's
are, or the same in all rounds: Blender remembers the headers of each path it has read and cannot forget them
(`volume_grid_file_cache.cc` only ever adds to the map of files).
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from pathlib import Path

import blender_isolated  # before bpy
import bpy
import numpy as np
import resident

FILES, VOXELS = 1024, 10
ROUNDS = 30


def growth_mb(rounds: int, *, new_names: bool) -> float:
    """Growth of resident memory per round, in MB."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    megabytes = []
    folder = Path(tempfile.mkdtemp(prefix="volumes_", dir=bpy.app.tempdir))
    originals = [_written(folder / f"original_{k}.vdb", k) for k in range(FILES)]
    for number in range(rounds):
        files = [folder / f"prim_{k:04d}_{number if new_names else 0:012d}.vdb" for k in range(FILES)]
        for original, path in zip(originals, files, strict=True):
            shutil.copyfile(original, path)
        _show_and_remove(files)
        for path in files:
            path.unlink()
        resident.trim()
        megabytes.append(resident.resident_mb())
    shutil.rmtree(folder)
    return resident.growth_mb_a_round(megabytes)


def _written(path: Path, seed: int) -> Path:
    bpy.utils.expose_bundled_modules()
    import openvdb  # Blender's own, importable only after the line above

    rng = np.random.default_rng(seed)
    density, colour = openvdb.FloatGrid(), openvdb.Vec3SGrid()
    density.name, density.gridClass, colour.name = "density", openvdb.GridClass.FOG_VOLUME, "Cd"
    for grid, channels in ((density, ()), (colour, (3,))):
        grid.copyFromArray(rng.random((VOXELS, VOXELS, VOXELS, *channels), np.float32))
        grid.transform, grid.saveFloatAsHalf = openvdb.createLinearTransform(0.01), True
    openvdb.write(str(path), grids=[density, colour])
    return path


def _show_and_remove(files: list[Path]) -> None:
    for path in files:
        volume = bpy.data.volumes.new(path.stem)
        volume.filepath = str(path)
        volume.grids.load()  # headers before voxels, as in the extension
        bpy.context.scene.collection.objects.link(bpy.data.objects.new(path.stem, volume))
    bpy.context.view_layer.update()
    bpy.data.batch_remove([*bpy.data.objects, *bpy.data.volumes])
    bpy.context.view_layer.update()
    system = bpy.context.preferences.system
    limit = system.memory_cache_limit
    system.memory_cache_limit = 1
    system.memory_cache_limit = limit


def figures(rounds: int) -> dict[str, float]:
    """Growth per round with as many files as a person has.

    The rounds with equal names come first, because Blender retains the memory of the others.
    """
    same = growth_mb(rounds, new_names=False)
    return {"bare_growth_mb_same_paths": same, "bare_growth_mb_new_paths": growth_mb(rounds, new_names=True)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    print(json.dumps(figures(parser.parse_args().rounds), indent=1), flush=True)
    blender_isolated.remove()
    os._exit(0)  # bpy as a module may hang at exit


if __name__ == "__main__":
    main()
