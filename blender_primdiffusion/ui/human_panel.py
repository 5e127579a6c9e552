"""The sidebar panel Human: the selected human."""

from __future__ import annotations

import bpy

from ..backend.requests import sentence
from ..jobs.deferred_volumes import deferred_volumes
from ..jobs.target import selected_person
from .drawing import SidebarPanel, draw_lines


class PRIMDIFFUSION_PT_human(SidebarPanel, bpy.types.Panel):
    """Who is selected, by name."""

    bl_label = "Human"
    bl_order = 1
    manual_page = "editing"

    def draw(self, context: bpy.types.Context) -> None:
        if deferred_volumes.error:
            draw_lines(self.layout, deferred_volumes.error, "ERROR")
        try:
            self.layout.prop(selected_person(context), "name", text="", icon="OUTLINER_OB_ARMATURE")
        except ValueError as error:
            draw_lines(self.layout, sentence(error), "INFO")
