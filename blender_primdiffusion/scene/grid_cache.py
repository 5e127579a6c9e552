"""What Blender keeps of VDB files that nothing shows any more, given back.

Blender holds every grid it has read in one cache, up to Preferences > System > Memory Cache Limit (4 GB by default):
deleting volumes, another file or undo free nothing. A grid of 8^3 voxels takes 0.9 MB there, most of it the empty
branches of its tree. Grids that are shown are held by their volumes as well and stay.
"""

from __future__ import annotations

import ctypes
import sys

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
