"""The sidebar panel Human: who is selected; what can be done with them hangs below it as sub-panels."""

from __future__ import annotations

import bpy

from ..jobs.target import selected_person


class PRIMDIFFUSION_PT_human(bpy.types.Panel):
    """The selected person's name."""

    bl_label = "Human"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_order = 2

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        try:
            self.layout.prop(selected_person(context), "name", text="")
        except ValueError as error:
            self.layout.label(text=str(error), icon="INFO")
