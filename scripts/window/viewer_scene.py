"""The viewer, without any backend; runs only on request and by itself (`--scenes viewer`)."""

from __future__ import annotations

from importlib import import_module

import bpy
from panels import sidebar, view
from press import Steps, pose, press, wait
from start import armatures, begin, queue_of, select
from visible_scene import at_rest

_MOST_S = 120.0


def viewer(module: str, _python: str) -> Steps:
    """The panels as they open, the sample human, a pose, material preview, the view rendered with Cycles."""
    yield from begin(module, "")
    yield from sidebar()
    yield "viewer_sidebar"
    folder = import_module(f"{module}.ui.menus").FOLDER
    press("primdiffusion.import_human", filepath=str(min(folder.glob("*.human"))))
    yield from wait(lambda: not queue_of(module).busy and bool(armatures()), _MOST_S)
    select(armatures()[0])
    yield from at_rest(module)
    yield "viewer_human"
    pose(armatures()[0], "Waving")
    press("view3d.view_selected", "EXEC_DEFAULT")
    _, area = view()
    area.spaces.active.shading.type = "MATERIAL"
    yield from at_rest(module)
    yield "viewer_posed"
    bpy.context.scene.render.engine = "CYCLES"
    bpy.context.scene.cycles.preview_samples = 8
    area.spaces.active.shading.type = "RENDERED"
    yield 40.0
    yield "viewer_cycles"
