"""Cancel a job, try a failed one again, release memory."""

from __future__ import annotations

import bpy

from . import memory
from .follow import redraw, submit
from .queue import queue

_SKIP = {"SKIP_SAVE"}


class PRIMDIFFUSION_OT_cancel(bpy.types.Operator):
    """Stop this work, or take it out of the line; nothing is added to the scene"""

    bl_idname = "primdiffusion.cancel"
    bl_label = "Cancel"
    bl_options: set[str] = set()  # noqa: RUF012

    number: bpy.props.IntProperty(
        name="Number", description="Of the work in line; 0 is the one under way", min=0, options=_SKIP
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only while something is in line."""
        cls.poll_message_set("Nothing is in line")
        return queue.busy

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Ask; the timer sees it through."""
        if not queue.cancel(self.number):
            which = f"work {self.number} is not in line any more" if self.number else "nothing is under way yet"
            self.report({"ERROR"}, which)
            return {"CANCELLED"}
        redraw()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_try_again(bpy.types.Operator):
    """Ask for the same once more"""

    bl_idname = "primdiffusion.try_again"
    bl_label = "Try Again"
    bl_options: set[str] = set()  # noqa: RUF012

    kind: bpy.props.StringProperty(
        name="Kind", description="Of work, like generate; empty: the last one that ended", options=_SKIP
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only after something has failed."""
        cls.poll_message_set("Nothing has failed")
        return any(outcome.error is not None for outcome in queue.outcomes.values())

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put the failed work in line again, for the scene at hand."""
        outcome = queue.outcomes.get(self.kind) if self.kind else queue.last
        if outcome is None or outcome.error is None:
            why = f"no work {self.kind!r} has failed" if self.kind else "the last work went well"
            self.report({"ERROR"}, why)
            return {"CANCELLED"}
        return submit(self, context, outcome.entry.work)


class PRIMDIFFUSION_OT_release_memory(bpy.types.Operator):
    """End the processes that generate and draw, and so give back what they hold; the next person starts them anew"""

    bl_idname = "primdiffusion.release_memory"
    bl_label = "Release Memory"
    bl_options: set[str] = set()  # noqa: RUF012

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Tell what was freed."""
        try:
            freed = memory.release()
        except RuntimeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, freed)
        redraw()
        return {"FINISHED"}


CLASSES = (
    PRIMDIFFUSION_OT_cancel,
    PRIMDIFFUSION_OT_try_again,
    PRIMDIFFUSION_OT_release_memory,
)
