"""A command line within Blender: a stdout of our own, progress in words, an end by Ctrl-C between pieces of work."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator

DONE, FAILED, UNUSABLE, NO_BACKEND, CANCELLED = 0, 1, 2, 3, 130
"""Exit codes: all is well; something failed, and the report lists it; nothing could be begun with these words; there is
no Python that runs the backend; told to stop."""


def duration(seconds: float) -> str:
    """Seconds in words for people."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


@contextlib.contextmanager
def stdout_of_our_own() -> Iterator[Callable[[str], None]]:
    """A way to write lines to stdout while all else that is written there, by Blender, is dropped."""
    sys.stdout.flush()
    ours = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)

    def say(line: str) -> None:
        os.write(ours, f"{line}\n".encode())

    try:
        yield say
    finally:
        sys.stdout.flush()
        os.dup2(ours, 1)
        os.close(ours)


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """Set by Ctrl-C or a polite kill, for the time between pieces of work; the second one ends the process at once.

    An exception would not do: raised while Cycles calls Python, it is printed and forgotten.
    """
    stop = threading.Event()

    def note(*_: object) -> None:
        if stop.is_set():
            os._exit(CANCELLED)
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
