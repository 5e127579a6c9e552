"""What is looked at: each scene a generator of pictures' names and of seconds to wait (see `drive.py`)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from importlib import import_module

import bpy

Steps = Iterator[float | str]


def view() -> tuple[bpy.types.Window, bpy.types.Area]:
    """The window and its 3D view."""
    window = bpy.context.window_manager.windows[0]
    return window, next(area for area in window.screen.areas if area.type == "VIEW_3D")


def sidebar() -> Iterator[float]:
    """Show the extension's tab."""
    _, area = view()
    area.spaces.active.show_region_ui = True
    yield 1.0
    region = next(region for region in area.regions if region.type == "UI")
    region.active_panel_category = "PrimDiffusion"
    yield 0.5


def press(operator: str, **given: object) -> set[str]:
    """A button: the operator is invoked in the 3D view, as a click does."""
    window, area = view()
    region = next(region for region in area.regions if region.type == "WINDOW")
    room, name = operator.split(".")
    with bpy.context.temp_override(window=window, area=area, region=region):
        return getattr(getattr(bpy.ops, room), name)("INVOKE_DEFAULT", **given)


def first_human(module: str) -> Steps:
    """The empty panel, a person in the making, the person."""
    yield from sidebar()
    yield "first_panel"
    press("primdiffusion.generate")
    yield 4.0
    yield "first_progress"
    queue = import_module(f"{module}.ui.jobs.queue").queue
    began = time.monotonic()
    while queue.busy and time.monotonic() - began < 120:
        yield 0.2
    yield 2.0
    yield "first_person"


SCENES = {"first_human": first_human}
