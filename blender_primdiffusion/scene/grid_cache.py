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
import sys
from collections.abc import Iterable
from pathlib import Path

import bpy

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
