"""Atomic writing: files are written to a temporary folder or name, and renamed into place when complete."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import psutil

STAGING_PREFIX = ".primdiffusion-partial-"
"""Followed by the id of the process. The next request in the folder removes what a killed process left."""


@contextlib.contextmanager
def staged(folder: str | Path) -> Iterator[Path]:
    """Yield a temporary folder inside `folder`, to which its files move at the end, replacing files of the same names.

    After an error everything is removed, including a newly created `folder`. Raises OSError, at once if `folder` cannot
    be written to.
    """
    target = Path(folder)
    made = _make(target)
    try:
        _remove_leftovers(target)
        aside = target / f"{STAGING_PREFIX}{os.getpid()}"
        aside.mkdir()
    except OSError:
        _unmake(made)
        raise
    try:
        yield aside
        for path in sorted(aside.iterdir()):
            os.replace(path, target / path.name)
        made = []
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        _unmake(made)


def _make(folder: Path) -> list[Path]:
    """Create `folder` and its missing parents; return the created ones, innermost first."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
    return missing


def _unmake(created: list[Path]) -> None:
    """Remove the created folders, unless they are in use."""
    for path in created:
        try:
            path.rmdir()
        except OSError:
            return


def _remove_leftovers(folder: Path) -> None:
    for path in folder.glob(f"{STAGING_PREFIX}*"):
        pid = path.name.removeprefix(STAGING_PREFIX)
        if not (pid.isdecimal() and int(pid) != os.getpid() and psutil.pid_exists(int(pid))):
            shutil.rmtree(path, ignore_errors=True)


@contextlib.contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` to write to; it is renamed at the end, or removed after an error.

    Raises OSError, naming `path`; PermissionError if it is a folder or a device, which renaming would replace.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise PermissionError(errno.EPERM, "this is not a regular file and will not be replaced", str(path))
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.partial")
    unfinished.unlink(missing_ok=True)  # a link of that name would be followed
    try:
        yield unfinished
        os.replace(unfinished, path)
    except OSError as e:
        if e.filename not in (None, str(unfinished), unfinished):
            raise
        raise type(e)(e.errno, e.strerror or str(e), str(path)) from e
    finally:
        unfinished.unlink(missing_ok=True)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file atomically; creates its folder. Raises OSError, naming `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
