"""Long work beside the queue, as a generator of steps: followed by a timer while there is a window, else waited for."""

from __future__ import annotations

import collections
import time

import bpy

from ..backend.requests import Steps, sentence
from ..files.regular_files import printable
from .windows import redraw

TICK_S = 0.1
_PRINT_S = 1.0
"""Between lines of progress on the console in background mode."""
_MOST_LINES = 200


class Session:
    """Runs the steps of one piece of work at a time. All methods are for Blender's main thread."""

    def __init__(self, busy: str, cancelled: str) -> None:
        """What to say while there is work, and of work that was cancelled."""
        self.message = ""
        self.fraction = 0.0
        self.lines: collections.deque[str] = collections.deque(maxlen=_MOST_LINES)
        """What the work has said, newest last."""
        self.error = ""
        """Why the last one failed, in a sentence."""
        self.notice = ""
        """How the last one ended otherwise."""
        self._steps: Steps | None = None
        self._busy, self._cancelled = busy, cancelled
        self._timer = self._follow  # Blender knows a timer by the object

    @property
    def busy(self) -> bool:
        """Whether there is work."""
        return self._steps is not None

    def start(self, steps: Steps) -> None:
        """Begin at the next tick. Raises ValueError while there is other work."""
        if self.busy:
            raise ValueError(f"{self._busy}: wait for it, or press Cancel")
        self._steps, self.error, self.notice, self.message, self.fraction = steps, "", "", "Starting", 0.0
        self.lines.clear()

    def tick(self) -> bool:
        """Continue; True when something visible changed. At the end `notice` or `error` is set."""
        if self._steps is None:
            return False
        before = (self.message, self.fraction, len(self.lines))
        try:
            step = next(self._steps)
        except StopIteration as done:
            self._steps, self.notice = None, done.value
        except (RuntimeError, OSError) as error:
            self._steps, self.error = None, sentence(error)
        else:
            self.message, self.fraction = step.message, step.fraction
            self.lines += step.lines
        return not self.busy or before != (self.message, self.fraction, len(self.lines))

    def cancel(self) -> None:
        """End the work and its processes at once."""
        if self._steps is not None:
            self._steps.close()
            self._steps, self.notice = None, self._cancelled

    def close(self) -> None:
        """As `cancel`, and no timer is left."""
        self.cancel()
        if bpy.app.timers.is_registered(self._timer):
            bpy.app.timers.unregister(self._timer)

    def follow(self, operator: bpy.types.Operator) -> set[str]:
        """The end of an operator that has started the work: errors are reported in background mode."""
        if not bpy.app.background:
            if not bpy.app.timers.is_registered(self._timer):
                bpy.app.timers.register(self._timer, first_interval=TICK_S, persistent=True)
            return {"FINISHED"}
        printed = 0.0
        try:
            while self.busy:
                if self.tick() and self.busy and time.monotonic() - printed > _PRINT_S:
                    printed = time.monotonic()
                    print(printable(f"PrimDiffusion: {self.message}"), flush=True)
                time.sleep(TICK_S / 4)
        finally:
            self.cancel()
        for line in filter(None, (*self.lines, self.notice)):
            print(printable(f"PrimDiffusion: {line}"), flush=True)
        if self.error:
            operator.report({"ERROR"}, self.error)
            return {"CANCELLED"}
        return {"FINISHED"}

    def _follow(self) -> float | None:
        if self.tick():
            redraw()
        return TICK_S if self.busy else None
