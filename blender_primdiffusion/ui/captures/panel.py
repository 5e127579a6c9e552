"""The sidebar panel Captures: 3D View > N > PrimDiffusion."""

from __future__ import annotations

from collections.abc import Callable

import bpy

from ..jobs.drawing import draw_lines
from ..manual import draw_manual_button
from .operators import RIG
from .session import captures

_SHOWN_LINES = 4


class _InSidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012


class PRIMDIFFUSION_PT_captures(_InSidebar, bpy.types.Panel):
    """From where to where, the button, and how far it is."""

    bl_label = "Captures"
    bl_order = 5

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual's page."""
        draw_manual_button(self.layout, "captures")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the session; starts nothing."""
        layout, asked = self.layout, context.scene.primdiffusion_captures
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        column.enabled = not captures.busy
        column.prop(asked, "people")
        column.prop(asked, "out")
        if captures.busy:
            left = f" ({_minutes(captures.eta_s)} left)" if captures.eta_s else ""
            layout.progress(factor=captures.fraction, text=f"{captures.message}{left}", translate=False)
            layout.operator("primdiffusion.cancel_captures", icon="CANCEL")
        else:
            layout.operator("primdiffusion.render_captures", icon="RENDER_ANIMATION")
        for text, icon in ((captures.error, "ERROR"), (captures.notice, "INFO")):
            draw_lines(layout, text, icon)
        if captures.busy or captures.error:
            for text in list(captures.lines)[-_SHOWN_LINES:]:
                draw_lines(layout, text, "DOT")


def _sub_panel(name: str, label: str, content: Callable) -> type:
    class SubPanel(_InSidebar, bpy.types.Panel):
        bl_idname = f"PRIMDIFFUSION_PT_captures_{name}"
        bl_label = label
        bl_parent_id = "PRIMDIFFUSION_PT_captures"
        __doc__ = content.__doc__

        def draw(self, context: bpy.types.Context) -> None:
            layout = self.layout
            layout.use_property_split = True
            layout.use_property_decorate = False
            layout.enabled = not captures.busy
            content(layout, context.scene.primdiffusion_captures, context)

    SubPanel.__name__ = SubPanel.bl_idname
    return SubPanel


def _draw_input(layout: bpy.types.UILayout, asked, _context) -> None:
    """Whose body, and which part of the people."""
    layout.prop(asked, "body")
    layout.prop(asked, "seed")
    row = layout.row(align=True)
    row.prop(asked, "shard")
    row.prop(asked, "shards")


def _draw_poses(layout: bpy.types.UILayout, asked, _context) -> None:
    """Which poses they take."""
    layout.prop(asked, "poses")
    layout.prop(asked, "pose_count")


def _draw_cameras(layout: bpy.types.UILayout, asked, context: bpy.types.Context) -> None:
    """Where the cameras stand."""
    layout.prop(asked, "arrangement")
    if asked.arrangement == "custom":
        layout.prop(asked, "cameras")
        if asked.cameras is None:
            layout.label(text="Without a collection: the selected cameras", icon="INFO")
        return
    layout.prop(asked, "camera_count")
    if asked.arrangement == "rings":
        for name in ("rings", "lowest", "highest"):
            layout.prop(asked, name)
    layout.prop(asked, "fov")
    layout.prop(asked, "margin")
    shown = RIG in context.scene.collection.children
    layout.operator(
        "primdiffusion.preview_rig", text="Hide Cameras" if shown else "Preview Cameras", icon="CAMERA_DATA"
    )


def _draw_cycles(layout: bpy.types.UILayout, asked, _context) -> None:
    """How Cycles renders."""
    layout.prop(asked, "samples")
    layout.prop(asked, "device")
    layout.prop(asked, "light")
    if asked.light == "hdri":
        layout.prop(asked, "hdri")
    if asked.light != "uniform":
        layout.prop(asked, "denoise")


def _draw_output(layout: bpy.types.UILayout, asked, _context) -> None:
    """What is written."""
    for name in ("width", "height", "background"):
        layout.prop(asked, name)
    layout.column().prop(asked, "passes")
    layout.column().prop(asked, "layouts")
    layout.prop(asked, "released_reference")
    row = layout.row(align=True)
    row.operator("primdiffusion.verify_captures", icon="CHECKMARK").repair = False
    row.operator("primdiffusion.verify_captures", text="Repair", icon="TOOL_SETTINGS").repair = True


SUB_PANELS = (
    _sub_panel("input", "Input", _draw_input),
    _sub_panel("poses", "Poses", _draw_poses),
    _sub_panel("cameras", "Cameras", _draw_cameras),
    _sub_panel("cycles", "Cycles", _draw_cycles),
    _sub_panel("output", "Output", _draw_output),
)


def _minutes(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{seconds:.0f} s" if seconds < 90 else f"{minutes} min" if minutes < 120 else f"{minutes / 60:.1f} h"
