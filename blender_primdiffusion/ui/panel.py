"""The sidebar panel: 3D View > N > PrimDiffusion."""

from __future__ import annotations

import textwrap

import bpy

from .generation import session

_LINE = 46


class PRIMDIFFUSION_PT_generate(bpy.types.Panel):
    """Seed, steps, Generate; progress and errors."""

    bl_label = "Generate Human"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the session; starts nothing."""
        layout, settings = self.layout, context.scene.primdiffusion
        layout.use_property_split = True
        column = layout.column()
        column.enabled = not session.busy
        column.prop(settings, "seed")
        column.prop(settings, "steps")
        layout.label(text=f"Device: {session.device or 'known after the first start'}", icon="MEMORY")
        job = session.job
        if job is None:
            layout.operator("primdiffusion.generate", icon="OUTLINER_OB_ARMATURE")
        else:
            left = f" ({job.eta_s:.0f} s left)" if job.eta_s else ""
            layout.progress(factor=job.fraction, text=f"{job.message}{left}")
            layout.operator("primdiffusion.cancel", icon="CANCEL")
        for text, icon in ((session.error, "ERROR"), (session.notice, "INFO")):
            for number, line in enumerate(textwrap.wrap(text, _LINE)):
                layout.label(text=line, icon=icon if number == 0 else "BLANK1")
