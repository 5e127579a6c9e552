"""The sidebar panels Jobs Left, above all others, and Jobs, below them: there only when there is something to show."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import bpy

from .drawing import draw_ended, draw_in_line, draw_lines
from .kept import home_of, is_open, meant_for
from .memory import device_line
from .queue import queue

if TYPE_CHECKING:
    from ...worker.kept_works import KeptWork

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
        """By the file and scene they were asked for."""
        by_place: dict[tuple[str, str], list[KeptWork]] = {}
        for kept in queue.kept.left:
            by_place.setdefault((kept.blend, kept.scene), []).append(kept)
        for works in by_place.values():
            _draw_left(self.layout.box(), works)


class PRIMDIFFUSION_PT_jobs(_InSidebar, bpy.types.Panel):
    """What is in line, what has ended, and the memory it takes. Progress is shown beside the button that asked."""

    bl_label = "Jobs"
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
        draw_lines(layout, queue.kept.trouble, "ERROR")
        draw_lines(layout, f"Device: {device_line()}", "MEMORY")
        column = layout.column(align=True)
        column.operator("primdiffusion.release_memory", icon="TRASH")
        column.operator("primdiffusion.copy_diagnostics", icon="COPYDOWN")


def _draw_left(layout: bpy.types.UILayout, works: list[KeptWork]) -> None:
    """Works that were asked for in one place, and what can be done with them."""
    first, column = works[0], layout.column(align=True)
    at_home = home_of(first) is not None
    column.label(text=f"For {meant_for(first)}", icon="FILE_BLEND", translate=False)
    for kept in works[:_SHOWN_LEFT]:
        column.label(text=kept.label, icon="TIME", translate=False)
    if len(works) > _SHOWN_LEFT:
        column.label(text=f"and {len(works) - _SHOWN_LEFT} more", translate=False)
    if not is_open(first.blend) and os.path.isfile(first.blend):
        words = f"Open {bpy.path.basename(first.blend)}"
        opening = layout.operator("wm.open_mainfile", text=words, translate=False, icon="FILE_FOLDER")
        opening.filepath, opening.display_file_selector = first.blend, False
    row = layout.row(align=True)
    resume = row.operator("primdiffusion.resume_works", text="Resume" if at_home else "Resume Here", icon="PLAY")
    discard = row.operator("primdiffusion.discard_works", icon="X")
    for button in (resume, discard):
        button.blend, button.scene = first.blend, first.scene
