"""What the panel Human says of missing files."""

from __future__ import annotations

import bpy

from ..jobs.drawing import draw_job, draw_lines
from .watching import state


def draw_missing(layout: bpy.types.UILayout) -> None:
    """What is missing and what can be done; nothing when everybody is whole."""
    if not state.told:
        return
    box = layout.box()
    draw_lines(box, f"Missing: {state.told}", "ERROR")
    row = box.row(align=True)
    draw_job(row.column(), "restore_volumes", "primdiffusion.find_missing_volumes", "VIEWZOOM")
    row.operator("primdiffusion.find_volumes_in_folder", text="", icon="FILE_FOLDER")
    for name in state.without_person_file:
        draw_job(box, "regenerate", "primdiffusion.generate_again", "FILE_REFRESH").human = name
