"""The sidebar panel Jobs: what is in line, what was left, and the memory it takes. There only when there is some."""

from __future__ import annotations

import bpy

from .drawing import draw_lines, draw_progress, draw_waiting
from .kept import meant_for
from .memory import device_line
from .queue import queue

_SHOWN_LEFT = 5


class PRIMDIFFUSION_PT_jobs(bpy.types.Panel):
    """The line, Resume and Discard, Release Memory."""

    bl_label = "Jobs"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_order = 0

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Something is in line, was left, or holds memory."""
        return queue.busy or bool(queue.kept.left) or queue.child_pid is not None or bool(queue.child_news)

    def draw(self, _context: bpy.types.Context) -> None:
        """Reads what is in line; starts nothing."""
        layout = self.layout
        _draw_left(layout)
        if queue.current is not None:
            layout.label(text=queue.current.work.label, icon="PLAY")
            if queue.job is not None:
                draw_progress(layout)
        draw_waiting(layout, list(queue.waiting))
        draw_lines(layout, queue.kept.trouble, "ERROR")
        draw_lines(layout, f"Device: {device_line()}", "MEMORY")
        row = layout.row(align=True)
        row.operator("primdiffusion.release_memory", icon="TRASH")
        row.operator("primdiffusion.copy_diagnostics", icon="COPYDOWN")


def _draw_left(layout: bpy.types.UILayout) -> None:
    left = queue.kept.left
    if not left:
        return
    box = layout.box()
    box.label(text=f"{len(left)} {'Job was' if len(left) == 1 else 'Jobs were'} Left", icon="RECOVER_LAST")
    column = box.column(align=True)
    for kept in left[:_SHOWN_LEFT]:
        column.label(text=f"{kept.label} ({meant_for(kept)})", icon="BLANK1")
    if len(left) > _SHOWN_LEFT:
        column.label(text=f"and {len(left) - _SHOWN_LEFT} more", icon="BLANK1")
    row = box.row(align=True)
    row.operator("primdiffusion.resume_works", text=f"Resume {len(left)}", icon="PLAY")
    row.operator("primdiffusion.discard_works", icon="X")
