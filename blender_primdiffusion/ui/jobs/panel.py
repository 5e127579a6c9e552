"""The sidebar panels Jobs Left, above all others, and Jobs, below them: there only when there is something to show."""

from __future__ import annotations

import bpy

from .drawing import draw_lines, draw_progress, draw_waiting
from .kept import meant_for
from .memory import device_line
from .queue import queue

_SHOWN_LEFT = 5


class _InSidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"


class PRIMDIFFUSION_PT_jobs_left(_InSidebar, bpy.types.Panel):
    """What an earlier Blender, or an earlier file, has left: Resume and Discard."""

    bl_label = "Jobs Left"
    bl_order = 0

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Something was left."""
        return bool(queue.kept.left)

    def draw(self, _context: bpy.types.Context) -> None:
        """Whom they were to make, and where."""
        left = queue.kept.left
        column = self.layout.column(align=True)
        for kept in left[:_SHOWN_LEFT]:
            column.label(text=kept.label, icon="TIME")
            column.label(text=f"for {meant_for(kept)}", icon="BLANK1")
        if len(left) > _SHOWN_LEFT:
            column.label(text=f"and {len(left) - _SHOWN_LEFT} more")
        row = self.layout.row(align=True)
        row.operator("primdiffusion.resume_works", text=f"Resume {len(left)}", icon="PLAY")
        row.operator("primdiffusion.discard_works", icon="X")


class PRIMDIFFUSION_PT_jobs(_InSidebar, bpy.types.Panel):
    """All that is in line, and the memory it takes."""

    bl_label = "Jobs"
    bl_order = 9

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Something is in line, or holds memory, or has died."""
        return queue.busy or queue.child_pid is not None or bool(queue.child_news)

    def draw(self, _context: bpy.types.Context) -> None:
        """Reads what is in line; starts nothing."""
        layout = self.layout
        if queue.current is not None:
            layout.label(text=queue.current.work.label, icon="PLAY")
            if queue.job is not None:
                draw_progress(layout)
        draw_waiting(layout, list(queue.waiting))
        draw_lines(layout, queue.kept.trouble, "ERROR")
        draw_lines(layout, f"Device: {device_line()}", "MEMORY")
        column = layout.column(align=True)
        column.operator("primdiffusion.release_memory", icon="TRASH")
        column.operator("primdiffusion.copy_diagnostics", icon="COPYDOWN")
