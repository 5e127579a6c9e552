"""Remove files and folders without leaving the folder that they belong to. Needs no numpy."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from .regular_files import FileError, real_path


def check_inside(path: Path, folder: Path) -> None:
    """Raise FileError unless `path` lies in `folder` after all links on the way to it are followed.

    `folder` itself may be reached through links. A link in the last component is not followed.
    """
    name, root = path.name, real_path(folder)
    place = real_path(path.parent) / name
    if name in ("", "..") or place == root or not place.is_relative_to(root):
        reason = f"lies outside of {folder}, behind a link, and stays as it is"
        raise FileError(path, reason, "remove the link, or the file itself")


def remove_file(path: Path, folder: Path) -> None:
    """Remove a file in `folder`, if it is there; of a link the link itself. Raises FileError, OSError."""
    check_inside(path, folder)
    path.unlink(missing_ok=True)


def remove_folder(path: Path, folder: Path) -> None:
    """Remove a folder in `folder` with its content, as far as the system permits; links are never followed.

    Raises FileError.
    """
    check_inside(path, folder)
    shutil.rmtree(path, ignore_errors=True)


def check_unlinked(folder: Path) -> None:
    """Raise FileError where a folder is, or contains, a link to a folder: writing would leave it."""
    below = (os.path.join(inner, name) for inner, names, _ in os.walk(folder) for name in names)
    for path in (str(folder), *below):
        if os.path.islink(path):
            raise FileError(path, "is a link to another folder", "remove the link, or choose a new folder")
