"""The one set-up under way, and how the last one ended."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:
    from ...worker.setup_job import Kind, SetUpJob
    from ...worker.setup_steps import Plan

TICK_S = 0.2
_TOLD_S = 2.0
"""Between lines of progress on the console in background mode."""


class SetUpSession:
    """Owns the process that sets up. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.job: SetUpJob | None = None
        """Under way; None when idle."""
        self.error = ""
        """Why the last one failed, in a sentence."""
        self.notice = ""
        """How the last one ended otherwise."""

    @property
    def busy(self) -> bool:
        """Something is being set up, repaired, tried or removed."""
        return self.job is not None

    def start(self, kind: Kind, plan: Plan) -> None:
        """Raises ValueError while another is under way, and OSError."""
        from ...worker.setup_job import SetUpJob

        if self.job is not None:
            raise ValueError("The backend is being set up already; wait for it, or press Cancel")
        job = SetUpJob(kind, plan)
        job.start()
        self.job, self.error, self.notice = job, "", ""

    def tick(self) -> bool:
        """Take in news; True when something visible changed. A finished job leaves its notice or error behind."""
        job = self.job
        if job is None:
            return False
        changed = job.tick()
        if job.finished:
            self.job = None
            self.error = job.message if job.state == "failed" else ""
            self.notice = "" if job.state == "failed" else job.message
        return changed or job.finished

    def cancel(self) -> None:
        """End it at once."""
        if self.job is not None:
            self.job.cancel()
            self.tick()


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
        while (job := session.job) is not None:
            if session.tick() and session.busy and time.monotonic() - printed > _TOLD_S:
                printed = time.monotonic()
                print(f"PrimDiffusion: {job.message}", flush=True)
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
    """Draw sidebars and preferences anew: nothing else tells them that the work has moved on."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"VIEW_3D", "PREFERENCES"}:
                area.tag_redraw()
