"""The sidebar panel Jobs: shown only while it has something to show."""

from __future__ import annotations

import bpy

from .drawing import draw_ended, draw_in_line, draw_lines
from .memory import device_line
from .queue import queue


class PRIMDIFFUSION_PT_jobs(bpy.types.Panel):
    """Queued and finished jobs, and the device. Progress is shown below the button that started the job."""

    bl_label = "Jobs"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_order = 9

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Something is in line or has ended, or holds memory, or has died."""
        return queue.busy or bool(queue.ended) or queue.child_pid is not None or bool(queue.child_news)

    def draw(self, _context: bpy.types.Context) -> None:
        """Reads what is in line; starts nothing."""
        layout = self.layout
        draw_in_line(layout)
        draw_ended(layout)
        draw_lines(layout, f"Device: {device_line()}", "MEMORY")
        column = layout.column(align=True)
        column.operator("primdiffusion.release_memory", icon="TRASH")
        column.operator("primdiffusion.copy_diagnostics", icon="COPYDOWN")
