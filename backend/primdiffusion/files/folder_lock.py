"""One process at a time in a folder."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from primdiffusion.files.regular_files import check_unlinked

LOCK = ".lock"
"""The lock file in the folder. It stays there: removing it while another process opens it would let two in."""


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Hold a folder, created if need be, for one process at a time. Raises ValueError, OSError.

    The system releases the lock when the process ends, however it ends.
    """
    folder.mkdir(parents=True, exist_ok=True)
    check_unlinked(folder / LOCK)
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(f"another process works in {folder}: wait for it, or give another folder") from None
    except NotImplementedError as e:
        raise ValueError(f"the disk of {folder} has no locks: give a folder on another disk") from e
    try:
        yield
    finally:
        lock.release()
