"""The sidebar panel Generate Human: 3D View > N > PrimDiffusion."""

from __future__ import annotations

import bpy

from .. import setup
from ..jobs.drawing import draw_job, draw_lines
from ..jobs.memory import device_line
from ..manual import draw_manual_button
from ..translations import CONTEXT
from .attributes import draw_attributes
from .presets import PRIMDIFFUSION_PT_generate_presets


class PRIMDIFFUSION_PT_generate(bpy.types.Panel):
    """Seed, quality, Generate; progress and errors."""

    bl_label = "Generate"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_order = 0

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The menu of presets, and the manual's page."""
        PRIMDIFFUSION_PT_generate_presets.draw_panel_header(self.layout)
        draw_manual_button(self.layout, "first_human")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads what is in line; starts nothing."""
        layout, settings = self.layout, context.scene.primdiffusion
        layout.use_property_split = True
        layout.use_property_decorate = False
        ready = setup.draw_set_up(layout)
        column = layout.column()
        row = column.row(align=True)
        row.prop(settings, "seed")
        row.prop(settings, "keep_seed", text="", icon="LOCKED" if settings.keep_seed else "UNLOCKED")
        row.operator("primdiffusion.random_seed", text="", icon="FILE_REFRESH")
        column.prop(settings, "count")
        column = layout.column()
        column.prop(settings, "quality")
        if settings.quality == "CUSTOM":
            column.prop(settings, "steps")
            column.prop(settings, "sampler")
        draw_job(layout, "generate", "primdiffusion.generate", "OUTLINER_OB_ARMATURE", ready)
        draw_lines(layout, f"Device: {device_line()}", "MEMORY")


class PRIMDIFFUSION_PT_attributes(bpy.types.Panel):
    """What the person is asked to be; nothing is asked for unless something is chosen."""

    bl_label = "Attributes"
    bl_translation_context = CONTEXT
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_parent_id = "PRIMDIFFUSION_PT_generate"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the checkpoint's card; starts nothing."""
        layout, settings = self.layout, context.scene.primdiffusion
        layout.use_property_split = True
        layout.use_property_decorate = False
        draw_attributes(layout, settings.attributes)
        layout.prop(settings, "guidance")
