"""A command line within Blender: a stdout of our own, progress in words, an end by Ctrl-C between pieces of work."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
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


class Stop:
    """Whether a command was asked to stop; read between pieces of work."""

    def __init__(self, ended: Callable[[], bool] = lambda: False) -> None:
        """`ended` is another reason to stop, looked at each time."""
        self._asked = False
        self.ended = ended

    def set(self) -> None:
        """Ask."""
        self._asked = True

    def is_set(self) -> bool:
        """Whether it was asked to."""
        self._asked = self._asked or self.ended()
        return self._asked


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[Stop]:
    """Set by Ctrl-C or a polite kill, for the time between pieces of work; the second one ends the process at once.

    An exception would not do: raised while Cycles calls Python, it is printed and forgotten.
    """
    stop = Stop()
    asked = []

    def note(*_: object) -> None:
        if asked:
            os._exit(CANCELLED)
        asked.append(True)
        stop.set()

    before = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, note)
    except ValueError:  # not in the main thread, which alone gets signals
        pass
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
