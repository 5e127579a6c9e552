"""Blender's Python module openvdb, and what there is of it where it is missing, as it may be in Debian.

Humans need no volumes to be drawn by PrimDiffusion, only by Cycles and EEVEE. So without the module nothing is refused
but writing: each writer raises ValueError.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import bpy

bpy.utils.expose_bundled_modules()
try:
    import openvdb as _openvdb
except ModuleNotFoundError:
    _openvdb = None


def openvdb() -> ModuleType:
    """The module. Raises ValueError where Blender's Python lacks it."""
    if _openvdb is None:
        raise ValueError(
            "the Python of this Blender lacks openvdb, without which volumes cannot be written for Cycles and EEVEE: "
            "install it (on Debian and Ubuntu: sudo apt install python3-openvdb), then start Blender again"
        )
    return _openvdb


def readable_format() -> int:
    """The newest format version that this Blender reads; 5.2 writes 225, and 5.0 reads up to 224.

    Without the module it is not known, and nothing can be written in another: any.
    """
    return sys.maxsize if _openvdb is None else _openvdb.FILE_FORMAT_VERSION


def grid_bytes(path: Path) -> int:
    """Bytes that a file's grids take once read, as its header says; 0 where it is damaged, and without the module."""
    if _openvdb is None:
        return 0
    try:
        return sum(grid.metadata.get("file_mem_bytes", 0) for grid in _openvdb.readAllGridMetadata(str(path)))
    except (OSError, RuntimeError):
        return 0
