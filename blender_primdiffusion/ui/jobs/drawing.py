"""How works look in panels: button, progress, errors."""

from __future__ import annotations

import textwrap

import bpy

from .queue import Entry, Outcome, queue

_LINE = 46


def draw_job(
    layout: bpy.types.UILayout, kind: str, operator_idname: str, icon: str
) -> bpy.types.OperatorProperties | None:
    """The button of an operator that submits works of `kind`, what is in line of them, and how the last one ended.

    Returns the button's properties, to be filled in.
    """
    props = layout.operator(operator_idname, icon=icon)
    entry = queue.current
    if entry is not None and entry.work.kind == kind:
        _draw_progress(layout)
    for waiting in queue.waiting:
        if waiting.work.kind == kind:
            _draw_waiting(layout, waiting)
    if (outcome := queue.outcomes.get(kind)) is not None:
        _draw_outcome(layout, outcome)
    return props


def draw_lines(layout: bpy.types.UILayout, text: str, icon: str) -> None:
    """A sentence on as many lines as it needs."""
    column = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(text, _LINE)):
        column.label(text=line, icon=icon if number == 0 else "BLANK1")


def _draw_progress(layout: bpy.types.UILayout) -> None:
    job = queue.job
    left = f" ({job.eta_s:.0f} s left)" if job.eta_s else ""
    layout.progress(factor=job.fraction, text=f"{job.message}{left}")
    layout.operator("primdiffusion.cancel", icon="CANCEL").number = 0


def _draw_waiting(layout: bpy.types.UILayout, entry: Entry) -> None:
    row = layout.row(align=True)
    row.label(text=f"In line: {entry.work.label}", icon="TIME")
    row.operator("primdiffusion.cancel", text="", icon="X").number = entry.number


def _draw_outcome(layout: bpy.types.UILayout, outcome: Outcome) -> None:
    draw_lines(layout, outcome.sentence, "ERROR")
    draw_lines(layout, outcome.notice, "INFO")
