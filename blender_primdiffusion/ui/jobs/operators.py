"""Cancel."""

from __future__ import annotations

import bpy

from .session import session


class PRIMDIFFUSION_OT_cancel(bpy.types.Operator):
    """Stop making the person; nothing is added to the scene"""

    bl_idname = "primdiffusion.cancel"
    bl_label = "Cancel"
    bl_options: set[str] = set()  # noqa: RUF012

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only while something runs."""
        return session.busy

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Ask; the timer sees it through."""
        session.cancel()
        return {"FINISHED"}
