"""Grids read before a volume shows them, some at a time: Blender would read all of a new person's at once. And again,
where Blender has looked for a file in vain."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import bpy


def read_grids(files: Sequence[Path], most_s: float) -> int:
    """Have Blender read the grids of as many files as it can in `most_s` seconds; how many these were, one at least.

    They are kept in its cache (see `grid_cache`); the .blend is not touched.
    """
    end = time.monotonic() + most_s
    with bpy.data.temp_data() as beside:  # removing a volume from bpy.data has Blender evaluate the scene anew
        volume = beside.volumes.new("PrimDiffusion")
        for count, path in enumerate(files, 1):
            if path.is_file():  # of one that is missing Blender would keep the error
                volume.filepath = str(path)
                for grid in volume.grids if volume.grids.load() else ():
                    grid.load()
            if time.monotonic() > end:
                return count
    return len(files)


def read_again(volume: bpy.types.Volume) -> None:
    """Have Blender show a volume whose file was missing when it looked: it looks no more, and keeps the error until
    grids are unloaded that were read."""
    volume.grids.load()
    volume.grids.unload()
    volume.update_tag()
