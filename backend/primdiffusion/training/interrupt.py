"""Stop a training loop between two steps."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from types import FrameType

log = logging.getLogger(__name__)

IMPATIENT = 2.0
"""Seconds after the first Ctrl-C before a second one stops at once: launchers forward the first one twice."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupt:
    """Stops loops after the current step: at a deadline, on SIGINT (Ctrl-C) or SIGTERM, so that no step is cut short.

    A second Ctrl-C, IMPATIENT seconds later, raises KeyboardInterrupt wherever the loop is.
    """

    def __init__(self, minutes: float | None):
        self.deadline = time.monotonic() + 60 * minutes if minutes is not None else float("inf")
        self.pressed = False
        self._at = 0.0
        self._process = os.getpid()
        self._before = {}

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._press) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _press(self, number: int, _frame: FrameType | None) -> None:
        if os.getpid() != self._process:
            return  # a loader's worker, which inherited this handler; its parent ends it
        if not self.pressed:
            log.info("stopping after this step")
            self.pressed, self._at = True, time.monotonic()
        elif number == signal.SIGINT and time.monotonic() - self._at > IMPATIENT:
            raise KeyboardInterrupt

    def due(self) -> bool:
        """Return whether to stop now."""
        return self.pressed or time.monotonic() > self.deadline
