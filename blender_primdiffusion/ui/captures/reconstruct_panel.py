"""The sidebar panel Human from Captures, below Render Captures: 3D View > N > PrimDiffusion."""

from __future__ import annotations

import bpy

from ..jobs.drawing import draw_job


class PRIMDIFFUSION_PT_human_from_captures(bpy.types.Panel):
    """From which pictures, of whom, the button; progress and errors."""

    bl_label = "Human from Captures"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_parent_id = "PRIMDIFFUSION_PT_captures"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Reads what is in line; starts nothing."""
        layout, asked = self.layout, context.scene.primdiffusion_reconstruct
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        for name in ("capture", "subject", "frame", "views"):
            column.prop(asked, name)
        draw_job(layout, "reconstruct", "primdiffusion.human_from_captures", "OUTLINER_OB_ARMATURE")
