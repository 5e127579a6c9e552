"""The sidebar panel Generate Human: 3D View > N > PrimDiffusion."""

from __future__ import annotations

import bpy

from ..jobs.drawing import draw_job
from ..jobs.memory import device_line
from .attributes import draw_attributes


class PRIMDIFFUSION_PT_generate(bpy.types.Panel):
    """Seed, steps, Generate; progress and errors."""

    bl_label = "Generate Human"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"

    def draw(self, context: bpy.types.Context) -> None:
        """Reads what is in line; starts nothing."""
        layout, settings = self.layout, context.scene.primdiffusion
        layout.use_property_split = True
        column = layout.column()
        column.prop(settings, "seed")
        column.prop(settings, "steps")
        column.prop(settings, "sampler")
        layout.label(text=f"Device: {device_line()}", icon="MEMORY")
        draw_job(layout, "generate", "primdiffusion.generate", "OUTLINER_OB_ARMATURE")


class PRIMDIFFUSION_PT_attributes(bpy.types.Panel):
    """What the person is asked to be; nothing is asked for unless something is chosen."""

    bl_label = "Attributes"
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
