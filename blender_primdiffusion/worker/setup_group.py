"""Processes that have processes: started as a group, ended as a group; and the guard of a folder."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

GROUP_FLAGS = getattr(subprocess, "CREATE_NO_WINDOW", 0) | getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
"""For Popen, with `start_new_session`: the new process heads a group, and opens no console window on Windows."""


def end_group(pid: int) -> None:
    """Ends the head of a group and all that it has started, at once. Nothing happens when they are gone."""
    if os.name == "nt":
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "stdin": subprocess.DEVNULL}
        command = ["taskkill", "/F", "/T", "/PID", str(pid)]
        subprocess.run(command, check=False, creationflags=subprocess.CREATE_NO_WINDOW, **quiet)
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


@contextlib.contextmanager
def guarded(path: Path) -> Iterator[None]:
    """The file is locked within; the system unlocks it when the process ends, however it ends.

    Raises BlockingIOError when another process holds it.
    """
    with path.open("a+b") as file:
        if os.name == "nt":
            import msvcrt

            try:
                file.seek(0)
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            except OSError as error:
                raise BlockingIOError(str(error)) from error
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
