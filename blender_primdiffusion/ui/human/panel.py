"""The sidebar panel Human: who is selected, whom else one may choose; what can be done with them are sub-panels."""

from __future__ import annotations

import bpy

from ...scene.human import armature_of, humans
from ...worker.sentence import sentence
from ..files.drawing import draw_missing
from ..jobs.drawing import draw_lines
from ..jobs.target import selected_person
from ..manual import draw_manual_button


class PRIMDIFFUSION_MT_people(bpy.types.Menu):
    """The people of the scene"""

    bl_label = "People"

    def draw(self, context: bpy.types.Context) -> None:
        """Choosing one selects them."""
        for person in humans(context.scene):
            choice = self.layout.operator("primdiffusion.select_human", text=person.name, icon="OUTLINER_OB_ARMATURE")
            choice.human = person.name


class PRIMDIFFUSION_PT_human(bpy.types.Panel):
    """Who is selected, by name."""

    bl_label = "Human"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_order = 2

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual's page."""
        draw_manual_button(self.layout, "editing")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        draw_missing(self.layout)
        row = self.layout.row(align=True)
        if humans(context.scene):
            row.menu("PRIMDIFFUSION_MT_people", text="", icon="OUTLINER_OB_ARMATURE")
        try:
            settings = armature_of(selected_person(context)).primdiffusion_human
        except ValueError as error:
            draw_lines(self.layout, sentence(error), "INFO")
            return
        row.prop(settings, "person", text="")
        row.operator("primdiffusion.select_human", text="", icon="RESTRICT_SELECT_OFF")
        row.operator("primdiffusion.frame_human", text="", icon="ZOOM_SELECTED")
        row.operator("primdiffusion.duplicate_human", text="", icon="DUPLICATE")
        row.operator("primdiffusion.delete_human", text="", icon="TRASH")
