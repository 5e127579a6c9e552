"""The sidebar panel Jobs, shown while there are any."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from ..jobs import follow
from ..jobs.follow import Reporting, redraw
from ..jobs.queue import queue
from .captures_panel import captures
from .declared import SKIP
from .drawing import SidebarPanel, draw_queue
from .preferences import cancel_set_up


class PRIMDIFFUSION_OT_cancel(Reporting, bpy.types.Operator):
    """Stop this job, or remove it from the queue; nothing is added to the scene"""

    bl_idname = "primdiffusion.cancel"
    bl_label = "Cancel"
    described_by = ("what",)

    what: bpy.props.EnumProperty(
        name="Cancel",
        description="What to stop",
        items=[
            ("JOB", "Job", "Stop this job, or remove it from the queue; nothing is added to the scene"),
            ("CAPTURES", "Captures", "Stop rendering; finished pictures stay, and the next run resumes from them"),
            ("SET_UP", "Set-Up", "Stop; the next Set Up Backend uses what was downloaded"),
        ],
        options=SKIP,
    )
    number: bpy.props.IntProperty(
        name="Number", description="Number of the queued job; 0 is the running one", min=0, options=SKIP
    )

    def act(self, _context: bpy.types.Context) -> set[str]:
        if self.what == "CAPTURES":
            if not captures.busy:
                raise ValueError("no captures are being rendered")
            captures.cancel()
        elif self.what == "SET_UP":
            cancel_set_up()
        elif not queue.cancel(self.number):
            which = f"job {self.number} is no longer queued" if self.number else "no job is running yet"
            raise ValueError(which)
        redraw()
        return {"FINISHED"}


class PRIMDIFFUSION_PT_jobs(SidebarPanel, bpy.types.Panel):
    """Queued jobs. Progress is shown below the button that started the job."""

    bl_label = "Jobs"
    bl_order = 5

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return queue.busy

    def draw(self, _context: bpy.types.Context) -> None:
        draw_queue(self.layout)


@persistent
def drop_before_loading(*_: object) -> None:
    """Handler of load_pre: the results of jobs belong into the file that is being closed."""
    queue.drop()


@persistent
def watch_after_loading(*_: object) -> None:
    """Handler of load_post, and of a load that failed: the timers start again."""
    follow.schedule_watchdog()


HANDLERS = (
    ("load_pre", drop_before_loading),
    ("load_post", watch_after_loading),
    ("load_post_fail", watch_after_loading),
)


def register() -> None:
    """Notice a child that dies between jobs; in background mode no timer runs."""
    if not bpy.app.background:
        follow.schedule_watchdog()


def unregister() -> None:
    """End the child and the timers."""
    queue.close()
    for timer in (follow.follow, follow.watch):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
