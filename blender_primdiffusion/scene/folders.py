"""Where files of people live, and how a .blend names them."""

from __future__ import annotations

from pathlib import Path

import bpy

TEMPORARY = "primdiffusion_humans"
"""Folder of the people of a .blend that was never saved, among Blender's temporary files."""


def humans_folder(blend_path: str | None = None) -> Path:
    """Where the people of a .blend live: `<blendname>_humans` beside it, a temporary folder while it is unsaved."""
    blend = Path(blend_path if blend_path is not None else bpy.data.filepath)
    if blend.name:
        return blend.resolve().parent / f"{blend.stem}_humans"
    return Path(bpy.app.tempdir) / TEMPORARY


def stored_path(path: Path) -> str:
    """A path as a .blend should hold it: relative (`//`) when the .blend is saved, else absolute."""
    if not bpy.data.filepath:
        return str(path)
    try:
        return bpy.path.relpath(str(path))
    except ValueError:  # another drive on Windows
        return str(path)
