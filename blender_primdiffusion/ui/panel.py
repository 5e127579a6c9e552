"""The sidebar panel Generate Human: 3D View > N > PrimDiffusion."""

from __future__ import annotations

import textwrap

import bpy

from .attributes import draw_attributes
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
        column.prop(settings, "sampler")
        layout.label(text=f"Device: {session.device or 'known after the first start'}", icon="MEMORY")
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
        layout.enabled = not session.busy
        draw_attributes(layout, settings.attributes)
        layout.prop(settings, "guidance")


def draw_job(layout: bpy.types.UILayout, kind: str, button: str, icon: str) -> None:
    """The button of an operator that makes people by the child's method `kind`; its progress, errors and news."""
    job = session.job
    if job is None or session.kind != kind:
        layout.operator(button, icon=icon)
    else:
        left = f" ({job.eta_s:.0f} s left)" if job.eta_s else ""
        layout.progress(factor=job.fraction, text=f"{job.message}{left}")
        layout.operator("primdiffusion.cancel", icon="CANCEL")
    if session.kind != kind:
        return
    for text, news_icon in ((session.error, "ERROR"), (session.notice, "INFO")):
        for number, line in enumerate(textwrap.wrap(text, _LINE)):
            layout.label(text=line, icon=news_icon if number == 0 else "BLANK1")
