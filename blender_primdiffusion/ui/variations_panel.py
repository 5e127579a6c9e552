"""The sidebar panel Variations: a contact sheet."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy.app.handlers import persistent
from bpy.app.translations import pgettext_iface

from ..jobs.pictures import icons
from ..jobs.queue import queue
from ..jobs.variations import sheet
from .drawing import SidebarPanel, draw_job, property_columns

if TYPE_CHECKING:
    from ..jobs.variations import VariationsJob

CELL_PX = 110
"""Width of a picture at which a sidebar of ordinary width holds two or three."""
MOST_COLUMNS = 8
_MARGIN_PX = 40
"""Borders and scroll bar of the sidebar."""
_UNIT_PX = 20
"""Of Blender's interface at a scale of 1: what `template_icon` counts in."""


class PRIMDIFFUSION_PT_variations(SidebarPanel, bpy.types.Panel):
    """Humans to choose from."""

    bl_label = "Variations"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}
    manual_page, manual_section = "first_human", "variations"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion_variations
        column = layout.column()
        column.row().prop(settings, "count", expand=True)
        column.prop(settings, "seeds")
        column.prop(settings, "quality")
        draw_job(layout, "variations", "primdiffusion.variations", "LIGHTPROBE_VOLUME")
        job = queue.current.job if queue.current is not None else None
        if job is not None and job.kind == "variations":
            _draw_progress(layout, _columns(context), job)
        elif sheet.variations:
            _draw_sheet(layout, _columns(context))
            _draw_choice(layout, settings)


def _columns(context: bpy.types.Context) -> tuple[int, float]:
    """Number of columns, and the size of a picture in interface units."""
    scale = context.preferences.system.ui_scale or 1.0  # 0 without a window
    width = (context.region.width if context.region is not None else 300 * scale) / scale - _MARGIN_PX
    number = max(2, min(MOST_COLUMNS, int(width // CELL_PX)))
    return number, max(2.0, (width / number - 10) / _UNIT_PX)


def _grid(layout: bpy.types.UILayout, columns: int) -> bpy.types.UILayout:
    return layout.grid_flow(row_major=True, columns=columns, even_columns=True, even_rows=True, align=False)


def _draw_progress(layout: bpy.types.UILayout, columns: tuple[int, float], job: VariationsJob) -> None:
    """The humans that are being generated, so far."""
    grid = _grid(layout, columns[0])
    for index, seed in enumerate(job.seeds):
        cell = grid.column(align=True)
        _draw_picture(cell, queue.request.pictures.get(index), columns[1])
        cell.label(text=str(seed))


def _draw_sheet(layout: bpy.types.UILayout, columns: tuple[int, float]) -> None:
    layout.label(text=f"{sheet.title}: {len(sheet.variations)}", translate=False)
    grid = _grid(layout, columns[0])
    for index, variation in enumerate(sheet.variations):
        cell = grid.column(align=True)
        _draw_picture(cell, variation.picture, columns[1])
        icon = "CHECKBOX_HLT" if variation.chosen else "CHECKBOX_DEHLT"
        button = cell.operator(
            "primdiffusion.select_variation", text=str(variation.seed), icon=icon, depress=variation.chosen
        )
        button.index = index


def _draw_picture(cell: bpy.types.UILayout, path: Path | None, units: float) -> None:
    cell.box().template_icon(icon_value=icons.of(path), scale=units)


def _draw_choice(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup) -> None:
    number = sum(variation.chosen for variation in sheet.variations)
    chosen = layout.row()
    chosen.enabled = number > 0
    chosen.operator(
        "primdiffusion.build_variation",
        text=f"{pgettext_iface('Build Selected')} ({number})",
        translate=False,
        icon="OUTLINER_OB_ARMATURE",
    )
    row = layout.row(align=True)
    row.operator("primdiffusion.build_variation", text="Build All").build_all = True
    row.operator("primdiffusion.clear_variations", text="Clear", icon="TRASH")
    column = layout.column()
    column.enabled = number == 1
    row = column.row(align=True)
    row.operator("primdiffusion.more_like_variation", icon="DUPLICATE")
    seed = row.row(align=True)
    seed.enabled = not sheet.around
    seed.operator("primdiffusion.use_variation_seed", icon="COPYDOWN")
    column.prop(settings, "amount")


@persistent
def clear_before_loading(*_: object) -> None:
    """Handler of load_pre: the sheet belongs to the file that is being closed."""
    sheet.clear()
    icons.free()


HANDLERS = (("load_pre", clear_before_loading),)


def unregister() -> None:
    """Remove the sheet and its files."""
    clear_before_loading()
