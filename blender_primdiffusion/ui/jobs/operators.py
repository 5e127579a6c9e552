"""Cancel."""

from __future__ import annotations

import bpy

from .follow import redraw
from .queue import queue


class PRIMDIFFUSION_OT_cancel(bpy.types.Operator):
    """Stop this work, or take it out of the line; nothing is added to the scene"""

    bl_idname = "primdiffusion.cancel"
    bl_label = "Cancel"
    bl_options: set[str] = set()  # noqa: RUF012

    number: bpy.props.IntProperty(
        name="Number", description="Of the work in line; 0 is the one under way", min=0, options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only while something is in line."""
        return queue.busy

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Ask; the timer sees it through."""
        if not queue.cancel(self.number):
            self.report({"ERROR"}, f"there is no work {self.number} in line: it has ended")
            return {"CANCELLED"}
        redraw()
        return {"FINISHED"}
