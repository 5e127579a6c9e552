"""Blender's cache of VDB grids: how much memory grids take, reading them ahead of time, and freeing them.

Blender holds every grid it has read in one cache, up to Preferences > System > Memory Cache Limit (4 GB by default).
Deleting volumes, opening another file or undo free nothing. A float grid of 8^3 voxels takes 0.3 MB there and a colour
grid 0.6 MB, mostly for the upper nodes of the tree, tables of 32^3 entries of 8 and 16 bytes: OpenVDB's standard tree,
the only one Blender reads. Volumes that are shown do not need the cache, since they have bounds and copies of their
own; Blender reads the files again where it evaluates them anew, as after undo, or renders.

Blender also remembers the headers of each path it has read, some 7 kB for two grids, until it quits; no call frees them
(benchmarks/extension_bare.py).
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
from .volumes import openvdb

_LOWEST_LIMIT_MB = 1


def free_unused_grids() -> None:
    """Empty the cache by lowering its limit for a moment, and return the memory to the system where possible."""
    preferences = bpy.context.preferences
    was_dirty, limit = preferences.is_dirty, preferences.system.memory_cache_limit
    preferences.system.memory_cache_limit = _LOWEST_LIMIT_MB
    preferences.system.memory_cache_limit = limit
    preferences.is_dirty = was_dirty
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc alone has it
        if trim is not None:
            trim(0)


def read_headers(files: Iterable[Path]) -> None:
    """Make Blender read the headers of VDB files before it reads their voxels: .1 s for 1024 of them.

    Blender never frees headers. Allocated among voxels, they would fragment the memory of these when it is freed, so
    that as much again is lost. Only for files that exist: Blender remembers the error of a missing one. The .blend is
    not touched.
    """
    with bpy.data.temp_data() as temporary:
        volume = temporary.volumes.new("PrimDiffusion")
        for path in files:
            volume.filepath = str(path)
            volume.grids.load()


def read_grids(files: Sequence[Path], budget_s: float) -> int:
    """Make Blender read the grids of as many files as it can in `budget_s` seconds, at least one; returns how many.

    They stay in its cache; the .blend is not touched. Otherwise Blender reads all grids of a new human at once.
    """
    end = time.monotonic() + budget_s
    with bpy.data.temp_data() as temporary:  # removing a volume from bpy.data makes Blender evaluate the scene again
        volume = temporary.volumes.new("PrimDiffusion")
        for count, path in enumerate(files, 1):
            if path.is_file():  # Blender remembers the error of a missing file
                volume.filepath = str(path)
                for grid in volume.grids if volume.grids.load() else ():
                    grid.load()
            if time.monotonic() > end:
                return count
    return len(files)


def reload_volume(volume: bpy.types.Volume) -> None:
    """Make Blender show a volume whose file was missing before: it remembers the error until grids are unloaded."""
    volume.grids.load()
    volume.grids.unload()
    volume.update_tag()


@dataclasses.dataclass(frozen=True)
class Memory:
    """Bytes of a human's volumes."""

    files: int
    """On disk."""
    grids: int
    """In memory once drawn: the trees of voxels, as in the files' headers. Cycles makes copies of its own when it
    renders."""


def person_memory(collection: bpy.types.Collection) -> Memory:
    """Memory of all of a human's volumes, shown or hidden, without missing files.

    Reads the files' headers once, about .2 s for 1024 of them, and caches the result by their names.
    """
    paths = {volume_path(obj.data) for obj in collection.all_objects if obj.type == "VOLUME"}
    return _memory_of(tuple(sorted(paths)))


@functools.lru_cache(maxsize=64)
def _memory_of(paths: Sequence[Path]) -> Memory:
    vdb = openvdb()
    files = grids = 0
    for path in paths:
        if not path.is_file():
            continue
        files += path.stat().st_size
        try:
            grids += sum(grid.metadata.get("file_mem_bytes", 0) for grid in vdb.readAllGridMetadata(str(path)))
        except (OSError, RuntimeError):
            continue  # a damaged file takes no memory
    return Memory(files, grids)
