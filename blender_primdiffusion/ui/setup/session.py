"""The one set-up under way, and how the last one ended."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import bpy

from ...worker.sentence import sentence

if TYPE_CHECKING:
    from ...worker.setup import Steps

TICK_S = 0.2
_PRINT_S = 2.0
"""Between lines of progress on the console in background mode."""


class SetUpSession:
    """Drives the steps of a set-up, a repair, a test or a removal. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.message = ""
        """What is being done."""
        self.fraction = 0.0
        self.error = ""
        """Why the last one failed, in a sentence."""
        self.notice = ""
        """How the last one ended otherwise."""
        self._steps: Steps | None = None

    @property
    def busy(self) -> bool:
        """Something is being set up, repaired, tested or removed."""
        return self._steps is not None

    def start(self, steps: Steps) -> None:
        """Begin at the next tick. Raises ValueError while another is under way."""
        if self.busy:
            raise ValueError("The backend is being set up already; wait for it, or press Cancel")
        self._steps, self.error, self.notice, self.message, self.fraction = steps, "", "", "Starting", 0.0

    def tick(self) -> bool:
        """Go on; True when something visible changed. One that has ended leaves its notice or error behind."""
        if self._steps is None:
            return False
        before = (self.message, self.fraction)
        try:
            step = next(self._steps)
        except StopIteration as done:
            self._steps, self.notice = None, done.value
        except (RuntimeError, OSError) as error:  # SetUpFailed is one
            self._steps, self.error = None, sentence(error)
        else:
            self.message, self.fraction = step.message, step.fraction
        return not self.busy or before != (self.message, self.fraction)

    def cancel(self) -> None:
        """End it and what it has started, at once."""
        if self._steps is not None:
            self._steps.close()
            self._steps, self.notice = None, "Cancelled; what has been downloaded is used by the next Set Up Backend"


session = SetUpSession()
"""Blender has one main thread and one user: one session."""


def see_through(operator: bpy.types.Operator) -> set[str]:
    """With a window a timer follows; in background mode this waits, and reports an error."""
    if not bpy.app.background:
        if not bpy.app.timers.is_registered(follow):
            bpy.app.timers.register(follow, first_interval=TICK_S, persistent=True)
        return {"FINISHED"}
    printed = 0.0
    try:
        while session.busy:
            if session.tick() and session.busy and time.monotonic() - printed > _PRINT_S:
                printed = time.monotonic()
                print(f"PrimDiffusion: {session.message}", flush=True)
            time.sleep(TICK_S / 4)
    finally:
        session.cancel()
    if session.error:
        operator.report({"ERROR"}, session.error)
        return {"CANCELLED"}
    print(f"PrimDiffusion: {session.notice}", flush=True)
    return {"FINISHED"}


def follow() -> float | None:
    """The timer."""
    if session.tick():
        redraw()
    return TICK_S if session.busy else None


def redraw() -> None:
    """Draw sidebars and preferences anew: nothing else tells them that there is news."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"VIEW_3D", "PREFERENCES"}:
                area.tag_redraw()
