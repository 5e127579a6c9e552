"""The sidebar panel Human: the selected human."""

from __future__ import annotations

import bpy

from ..backend.requests import sentence
from ..jobs.target import selected_person
from ..jobs.volumes import faults
from .drawing import SidebarPanel, draw_lines


class PRIMDIFFUSION_PT_human(SidebarPanel, bpy.types.Panel):
    """Who is selected, by name."""

    bl_label = "Human"
    bl_order = 1
    manual_page = "editing"

    def draw(self, context: bpy.types.Context) -> None:
        if faults.text:
            draw_lines(self.layout, faults.text, "ERROR")
        try:
            self.layout.prop(selected_person(context), "name", text="", icon="OUTLINER_OB_ARMATURE")
        except ValueError as error:
            draw_lines(self.layout, sentence(error), "INFO")
