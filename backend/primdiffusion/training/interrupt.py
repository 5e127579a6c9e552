"""Asking a training loop to stop between two steps."""

from __future__ import annotations

import logging
import signal
import threading
import time
from types import FrameType

log = logging.getLogger(__name__)


class Interrupt:
    """Asks loops to stop after the current step: at a deadline or on Ctrl-C, which thus never tears a step apart."""

    def __init__(self, minutes: float | None):
        self.deadline = time.monotonic() + 60 * minutes if minutes is not None else float("inf")
        self.pressed = False
        self._before = None

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._press)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _press(self, _number: int, _frame: FrameType | None) -> None:
        log.info("stopping after this step")
        self.pressed = True

    def due(self) -> bool:
        """Whether to stop now."""
        return self.pressed or time.monotonic() > self.deadline
