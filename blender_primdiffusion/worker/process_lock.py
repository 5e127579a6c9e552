"""A file that is locked for as long as its process lives: others can tell the living from the dead.

Process ids are used again, and asking Windows for one by os.kill ends it; the system gives a lock back at any death.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO

if os.name == "nt":
    import msvcrt

    def _lock(file: IO[bytes]) -> None:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _lock(file: IO[bytes]) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


class ProcessLock:
    """Holds the lock of `path`, a new file, until `release` or the end of the process."""

    def __init__(self, path: Path):
        """Raises OSError where the file cannot be made, or somebody else holds it."""
        self._path = path
        self._file = path.open("ab")
        try:
            _lock(self._file)
        except OSError:
            self._file.close()
            raise

    def release(self) -> None:
        """Let go, and remove the file."""
        self._file.close()
        self._path.unlink(missing_ok=True)


def is_locked(path: Path) -> bool:
    """Whether a living process holds the lock of `path`; one that cannot be asked for counts as held."""
    try:
        with path.open("r+b") as file:
            _lock(file)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False
