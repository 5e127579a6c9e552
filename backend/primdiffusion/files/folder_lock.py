"""One process at a time in a folder."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from primdiffusion.files.regular_files import check_unlinked, remove_file
from primdiffusion.files.whole_files import create_folders, remove_empty

LOCK = ".lock"
"""The lock file in the folder. It stays there: removing it while another process opens it would let two in."""


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Hold a folder, created if need be, for one process at a time. Raises ValueError, OSError.

    The system releases the lock when the process ends, however it ends. On a disk without locks the file itself is the
    lock: it names its process, and counts for nothing once that has ended. A created folder that holds nothing else in
    the end is removed.
    """
    made = create_folders(folder)
    lock: BaseFileLock | None = None
    try:
        check_unlinked(folder / LOCK)
        lock = _acquired(folder)
        yield
    finally:
        if lock is not None:
            if made:
                _remove_if_alone(folder / LOCK)  # while it is held: the next process then makes a new one
            lock.release()
            if made:
                _remove_if_alone(folder / LOCK)  # Windows removes no open files
        remove_empty(made)


def _acquired(folder: Path) -> BaseFileLock:
    for kind in (FileLock, SoftFileLock):
        lock = kind(folder / LOCK)
        try:
            lock.acquire(timeout=0)
            return lock
        except Timeout:
            raise ValueError(f"another process works in {folder}: wait for it, or give another folder") from None
        except (OSError, NotImplementedError):
            if kind is SoftFileLock:
                raise
    raise AssertionError("one of the two returns or raises")


def _remove_if_alone(path: Path) -> None:
    with contextlib.suppress(OSError):
        if list(path.parent.iterdir()) == [path]:
            remove_file(path, path.parent)
