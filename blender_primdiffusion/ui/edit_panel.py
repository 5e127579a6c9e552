"""Edits of the selected person: sub-panels of Human."""

from __future__ import annotations

from collections.abc import Callable

import bpy

from ..formats.requests import SIDED_PARTS, WHOLE_PARTS
from ..jobs.target import selected_person
from ..scene.human import body_of, humans
from .attributes import draw_attributes
from .drawing import SidebarPanel, draw_job, property_columns
from .edit_operators import painting


def _sub_panel(name: str, label: str, order: int, content: Callable) -> type:
    class EditSubPanel(SidebarPanel, bpy.types.Panel):
        bl_idname = f"PRIMDIFFUSION_PT_edit_{name}"
        bl_label = label
        bl_parent_id = "PRIMDIFFUSION_PT_human"
        bl_order = order
        bl_options = {"DEFAULT_CLOSED"}
        __doc__ = content.__doc__

        @classmethod
        def poll(cls, context: bpy.types.Context) -> bool:
            return name == "files" or bool(humans(context.scene))

        def draw(self, context: bpy.types.Context) -> None:
            property_columns(self.layout)
            content(self.layout, context.scene.primdiffusion_edit, context)

    EditSubPanel.__name__ = EditSubPanel.bl_idname
    return EditSubPanel


def _draw_vary(layout: bpy.types.UILayout, settings, _context) -> None:
    """How far, and the button."""
    layout.prop(settings, "amount")
    layout.prop(settings, "seed")
    draw_job(layout, "vary", "primdiffusion.vary", "MOD_NOISE")


def _draw_redress(layout: bpy.types.UILayout, settings, context) -> None:
    """Where, into what, and the button."""
    _draw_region(layout, settings, context)
    draw_attributes(layout, settings.attributes)
    layout.prop(settings, "seed")
    draw_job(layout, "inpaint", "primdiffusion.redress", "MATCLOTH")


def _draw_transfer(layout: bpy.types.UILayout, settings, context) -> None:
    """From whom, where, and the button."""
    layout.prop(settings, "other")
    _draw_region(layout, settings, context)
    layout.row().prop(settings, "what", expand=True)
    layout.prop(settings, "harmonise")
    if settings.harmonise > 0:
        layout.prop(settings, "seed")
    draw_job(layout, "transfer", "primdiffusion.transfer_texture", "TEXTURE", settings.other is not None)


def _draw_blend(layout: bpy.types.UILayout, settings, _context) -> None:
    """With whom, how far, and the button."""
    layout.prop(settings, "other")
    layout.prop(settings, "fraction")
    draw_job(layout, "interpolate", "primdiffusion.blend", "ARROW_LEFTRIGHT", settings.other is not None)


def _draw_files(layout: bpy.types.UILayout, _settings, _context) -> None:
    """People's files on disk: beside the .blend, and those that edits have left."""
    layout.operator("primdiffusion.collect_files", icon="PACKAGE")
    layout.operator("primdiffusion.find_volumes_in_folder", icon="VIEWZOOM")
    layout.operator("primdiffusion.remove_unused_files", icon="TRASH")


def _draw_region(layout: bpy.types.UILayout, settings, context: bpy.types.Context) -> None:
    layout.row().prop(settings, "region", expand=True)
    if settings.region == "PARTS":
        _draw_parts(layout, settings, WHOLE_PARTS, 3)
        header, body = layout.panel("primdiffusion_sides", default_closed=True)
        header.label(text="Left and Right")
        if body is not None:
            _draw_parts(body, settings, SIDED_PARTS, 2)
        return
    try:
        mesh = body_of(selected_person(context))
    except ValueError:
        mesh = None
    if mesh is not None:
        layout.prop_search(settings, "vertex_group", mesh, "vertex_groups", text="Group")
    action = "finish_painting" if painting(context) else "paint_region"
    layout.operator(f"primdiffusion.{action}", icon="BRUSH_DATA")


def _draw_parts(layout: bpy.types.UILayout, settings, parts: tuple[str, ...], columns: int) -> None:
    grid = layout.grid_flow(row_major=True, columns=columns, even_columns=True, align=True)
    grid.use_property_split = False
    for part in parts:
        grid.prop_enum(settings, "parts", part)


SUB_PANELS = (
    _sub_panel("vary", "Vary", 20, _draw_vary),
    _sub_panel("redress", "Re-dress Region", 21, _draw_redress),
    _sub_panel("transfer", "Transfer Texture", 22, _draw_transfer),
    _sub_panel("blend", "Blend", 23, _draw_blend),
    _sub_panel("files", "Files", 91, _draw_files),
)
