"""The section Variations of the panel Generate: a contact sheet of humans to select and build."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..backend.requests import sentence
from ..formats.requests import VariationsRequest
from ..jobs.follow import Reporting, submit
from ..jobs.queue import queue
from ..jobs.variations import Sheet, Variation, VariationsJob, backs, sheet
from ..jobs.windows import icons
from ..scene.build import build_human
from ..scene.place import stand_at_cursor
from .declared import SKIP, declared
from .drawing import draw_job, row_unless
from .generate_settings import LARGEST_SEED, last_seed, sampling, seed_property

MOST = 16
COUNT_ITEMS = [(str(count), str(count), f"{count} humans") for count in range(4, MOST + 1, 4)]


class PRIMDIFFUSION_PG_variations(bpy.types.PropertyGroup):
    """`scene.primdiffusion_variations`."""

    __slots__ = ()
    count: bpy.props.EnumProperty(
        name="Count", description="How many humans to choose from", items=COUNT_ITEMS, default="8"
    )
    amount: declared(VariationsRequest, "amount", name="Difference", min=0.05)


def _selected(_manager: bpy.types.WindowManager) -> list[bool]:
    chosen = [variation.chosen for variation in sheet.variations[:MOST]]
    return chosen + [False] * (MOST - len(chosen))


def _select(_manager: bpy.types.WindowManager, selected: Sequence[bool]) -> None:
    for variation, chosen in zip(sheet.variations, selected, strict=False):
        variation.chosen = chosen


class PRIMDIFFUSION_OT_variations(Reporting, bpy.types.Operator):
    """Show several new humans to choose from before building them, in the quality of the panel Generate"""

    bl_idname = "primdiffusion.variations"
    bl_label = "Show Variations"
    described_by = ("like",)

    seed: seed_property()
    like: bpy.props.BoolProperty(
        name="More Like This", description="Variations of a human of the sheet, with the same body", options=SKIP
    )

    def act(self, context: bpy.types.Context) -> set[str]:
        """A seed given by a script is the first of `count`; otherwise they are random."""
        settings, like = context.scene.primdiffusion_variations, {}
        if self.like:
            around, *others = _targets()
            if others:
                raise ValueError(f"{len(others) + 1} variations are selected: select only the one to vary")
            like = {"person": str(around.person), "amount": settings.amount, "title": f"Like seed {around.seed}"}
        seeds = _seeds(self.seed, int(settings.count))
        return submit(self, context, VariationsJob(seeds, sampling(context.scene.primdiffusion), **like))


def _seeds(first: int, count: int) -> tuple[int, ...]:
    """Seeds from `first` on, random ones where it is negative. Raises ValueError."""
    if first < 0:
        return tuple(random.sample(range(LARGEST_SEED + 1), count))
    return tuple(range(first, last_seed(first, count) + 1))


class PRIMDIFFUSION_OT_build_variation(Reporting, bpy.types.Operator):
    """Add the selected humans to the scene, exactly as shown, side by side"""

    bl_idname = "primdiffusion.build_variation"
    bl_label = "Build Selected"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if not sheet.variations:
            cls.poll_message_set("There are no variations: press Show Variations first")
        return bool(sheet.variations)

    def act(self, context: bpy.types.Context) -> set[str]:
        wanted = _targets()
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        built, failure = _build(context, wanted)
        if built:
            bpy.ops.ed.undo_push(message="Build Variation" if len(built) == 1 else f"Build {len(built)} Variations")
        if failure:
            self.report({"ERROR"}, f"{len(built)} of {len(wanted)} humans were built. {failure}")
            return {"FINISHED"} if built else {"CANCELLED"}
        return {"FINISHED"}


def _targets() -> list[Variation]:
    """The selected variations. Raises ValueError where there is none."""
    if not sheet.variations:
        raise ValueError("there are no variations: press Show Variations first")
    return sheet.chosen()


def _build(context: bpy.types.Context, wanted: list[Variation]) -> tuple[list[bpy.types.Object], str]:
    """The humans built, and what went wrong with the next one in a sentence; empty for nothing."""
    built: list[bpy.types.Object] = []
    context.window_manager.progress_begin(0, len(wanted))
    try:
        for variation in wanted:
            person = build_human(context, variation.person)
            built.append(person)
            stand_at_cursor(context, person)
            context.window_manager.progress_update(len(built))
    except (ValueError, OSError) as error:
        return built, sentence(error)
    finally:
        context.window_manager.progress_end()
    return built, ""


PROPERTIES = (
    (bpy.types.Scene, "primdiffusion_variations", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_variations)),
    (
        bpy.types.WindowManager,  # as the sheet: no undo changes it, no file keeps it
        "primdiffusion_selected",
        bpy.props.BoolVectorProperty(
            name="Select", description="Select this human, or not", size=MOST, get=_selected, set=_select
        ),
    ),
)


CELL_PX = 110
"""Width of a picture at which a sidebar of ordinary width holds two or three."""
MOST_COLUMNS = 8
_MARGIN_PX = 40
"""Borders and scroll bar of the sidebar."""
_UNIT_PX = 20
"""Pixels of a unit of Blender's interface at a scale of 1, in which `template_icon` counts."""


def draw_variations(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Humans to choose from."""
    settings = context.scene.primdiffusion_variations
    column = layout.column()
    column.row().prop(settings, "count", expand=True)
    draw_job(layout, "variations", "primdiffusion.variations", "LIGHTPROBE_VOLUME")
    job = queue.current.job if queue.current is not None else None
    if job is not None and job.kind == "variations":
        _draw_progress(layout, _columns(context), job)
    elif sheet.variations:
        _draw_sheet(layout, context)
        _draw_choice(layout, settings)


def _columns(context: bpy.types.Context) -> tuple[int, float]:
    """Number of columns, and the size of a picture in interface units."""
    scale = context.preferences.system.ui_scale or 1.0  # 0 without a window
    width = (context.region.width if context.region is not None else 300 * scale) / scale - _MARGIN_PX
    number = max(2, min(MOST_COLUMNS, int(width // CELL_PX)))
    return number, max(2.0, (width / number - 10) / _UNIT_PX)


def _grid(layout: bpy.types.UILayout, columns: int) -> bpy.types.UILayout:
    grid = layout.grid_flow(row_major=True, columns=columns, even_columns=True, even_rows=True, align=False)
    grid.use_property_split = False  # a seed stands on its button, not beside it
    return grid


def _draw_progress(layout: bpy.types.UILayout, columns: tuple[int, float], job: VariationsJob) -> None:
    """The humans that are being generated, so far."""
    grid = _grid(layout, columns[0])
    for index, seed in enumerate(job.seeds):
        cell = grid.column(align=True)
        _draw_picture(cell, queue.request.pictures.get(index), columns[1])
        cell.label(text=str(seed))


def draw_people(layout: bpy.types.UILayout, context: bpy.types.Context, people: Sheet) -> Iterator[tuple]:
    """Draw the pictures of a sheet; yields the index of each, its human, and the cell for the button below it."""
    columns, units = _columns(context)
    grid = _grid(layout, columns)
    for index, variation in enumerate(people.variations):
        cell = grid.column(align=True)
        _draw_picture(cell, variation.picture, units)
        yield index, variation, cell


def _draw_sheet(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    layout.label(text=f"{sheet.title}: {len(sheet.variations)}", translate=False)
    for index, variation, cell in draw_people(layout, context, sheet):
        icon = "CHECKBOX_HLT" if variation.chosen else "CHECKBOX_DEHLT"
        manager = bpy.context.window_manager
        cell.prop(manager, "primdiffusion_selected", index=index, text=str(variation.seed), icon=icon, toggle=True)


def _draw_picture(cell: bpy.types.UILayout, path: Path | None, units: float) -> None:
    cell.box().template_icon(icon_value=icons.of(path), scale=units)


def _draw_choice(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup) -> None:
    number = sum(variation.chosen for variation in sheet.variations)
    row_unless(layout, "" if number else "Select the humans to build").operator(
        "primdiffusion.build_variation",
        text=f"Build Selected ({number})",
        translate=False,
        icon="OUTLINER_OB_ARMATURE",
    )
    row = row_unless(layout, "" if number == 1 else "Select one human for this")
    row.operator("primdiffusion.variations", text="More Like This", icon="DUPLICATE").like = True
    layout.prop(settings, "amount")


@persistent
def clear_before_loading(*_: object) -> None:
    """Handler of load_pre: the sheet belongs to the file that is being closed."""
    sheet.clear()
    backs.clear()
    icons.free()


HANDLERS = (("load_pre", clear_before_loading),)


def unregister() -> None:
    """Remove the sheet and its files."""
    clear_before_loading()
