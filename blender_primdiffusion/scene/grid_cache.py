"""What Blender keeps of VDB files that it has read, given back.

Blender holds every grid it has read in one cache, up to Preferences > System > Memory Cache Limit (4 GB by default):
deleting volumes, another file or undo free nothing. A float grid of 8^3 voxels takes 0.3 MB there and a colour grid
0.6 MB, most of it the upper nodes of the tree, tables of 32^3 entries of 8 and 16 bytes: OpenVDB's standard tree, the
one Blender reads. Volumes that are shown go on without the cache, by bounds and copies of their own; Blender reads the
files again where it evaluates them anew, as after undo, or renders.

Of each path it has read Blender also remembers the headers, until it ends: some 7 kB for two grids, and no call frees
them (benchmarks/extension_bare.py).
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import bpy

from .files import volume_path

_LEAST_MB = 1


def free_unused_grids() -> None:
    """Empty the cache by lowering its limit for a moment, and hand the memory to the system where that can be asked."""
    preferences = bpy.context.preferences
    was_dirty, limit = preferences.is_dirty, preferences.system.memory_cache_limit
    preferences.system.memory_cache_limit = _LEAST_MB
    preferences.system.memory_cache_limit = limit
    preferences.is_dirty = was_dirty
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc alone has it
        if trim is not None:
            trim(0)


def read_headers(files: Iterable[Path]) -> None:
    """Have Blender read the headers of VDB files before it reads their voxels: .1 s for 1024 of them.

    It keeps the headers for good. Allocated among the voxels they would leave holes when those are freed, of as much
    memory again. Only for files that exist: of one that does not, Blender keeps the error. The .blend is not touched.
    """
    with bpy.data.temp_data() as beside:
        volume = beside.volumes.new("PrimDiffusion")
        for path in files:
            volume.filepath = str(path)
            volume.grids.load()


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


@dataclasses.dataclass(frozen=True)
class Memory:
    """Bytes of a person's volumes."""

    files: int
    """On disk."""
    grids: int
    """In memory once drawn: of the trees of voxels, as the files' own headers tell them. Most of it is the tree's upper
    nodes, which have one size whatever they hold. Cycles makes copies of its own while it renders."""


def person_memory(collection: bpy.types.Collection) -> Memory:
    """Of all volumes that the person shows or hides; files that are missing count nothing.

    Reads the files' headers once, about .2 s for 1024 of them, and remembers them by their names.
    """
    paths = {volume_path(thing.data) for thing in collection.all_objects if thing.type == "VOLUME"}
    return _memory_of(tuple(sorted(paths)))


@functools.lru_cache(maxsize=64)
def _memory_of(paths: Sequence[Path]) -> Memory:
    bpy.utils.expose_bundled_modules()
    import openvdb  # Blender's own, importable only after the line above

    files = grids = 0
    for path in paths:
        if not path.is_file():
            continue
        files += path.stat().st_size
        try:
            grids += sum(grid.metadata.get("file_mem_bytes", 0) for grid in openvdb.readAllGridMetadata(str(path)))
        except (OSError, RuntimeError):
            continue  # a damaged file takes no memory
    return Memory(files, grids)
