"""All files of a request or none: they are written to a folder of their own and renamed into place together."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import psutil

STAGING_PREFIX = ".primdiffusion-partial-"
"""Followed by the writing process' id; what a killed process leaves goes with the next one in the same folder."""


@contextlib.contextmanager
def staged(folder: str | Path) -> Iterator[Path]:
    """A folder to write into; on a good end its files move to `folder`, on an error all of it goes, a new `folder` too.

    Yields a new folder inside `folder`, so that a folder that cannot be written to fails here, before any work.
    Files of the same names in `folder` are replaced. Raises OSError.
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
    """Creates `folder` and its missing parents; returns the created ones, innermost first."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
    return missing


def _unmake(created: list[Path]) -> None:
    """Removes folders this process created, unless something else was put into them."""
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
    """A temporary name beside `path` to write to; renamed on a good end, removed on an error.

    Raises OSError, which names `path` itself; PermissionError where it is a folder or a device, which renaming would
    replace.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise PermissionError(errno.EPERM, "this is no ordinary file and will not be replaced", str(path))
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.partial")
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
    """The whole file or none, and nothing beside it. Raises OSError, which names `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
