"""Where an export goes: checked before the work begins, and again asked for nothing."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import bpy


def destination(filepath: str, endings: Sequence[str]) -> Path:
    """The file to write, with the first ending where it has none. Raises ValueError or OSError with what to do."""
    if not filepath or filepath.endswith(("/", "\\")):
        raise ValueError("name a file to export to")
    path = Path(bpy.path.abspath(filepath))
    if not path.is_absolute():
        raise ValueError(f"{filepath!r} is beside a .blend that was never saved: save it first, or give the whole path")
    if not path.suffix:
        path = path.with_suffix(endings[0])
    if path.suffix.lower() not in endings:
        raise ValueError(f"{path.name!r} has another ending than {', '.join(endings)}: rename it, or choose a format")
    if path.is_dir():
        raise ValueError(f"{str(path)!r} is a folder: name a file in it")
    check_writable(path.parent)
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(f"{str(path)!r} may not be written to: choose another file")
    return path


def check_writable(folder: Path) -> None:
    """Raises FileNotFoundError or PermissionError, with what to do, for a folder that takes no files."""
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {str(folder)!r}: make it first, or choose another")
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"the folder {str(folder)!r} may not be written to: choose another")
