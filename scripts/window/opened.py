"""Runs inside a new Blender: opens a .blend with a human and writes how soon it is in view to a JSON file.

    blender --python opened.py -- MODULE FILE.blend FIGURES.json

open_to_visible_seconds is from the moment when Blender has read the file, and open_seconds_window is what it took to
read it; opened_refined_seconds is until the picture is refined. Blender then quits.
"""

from __future__ import annotations

import json
import sys
import time
from importlib import import_module
from pathlib import Path

import bpy
import gpu

MODULE, BLEND, FIGURES = sys.argv[sys.argv.index("--") + 1 :]
LOOKED_AT_S = 4.0
"""The file of figures appears at once, for a screenshot."""
LONGEST_S = 200.0
found: dict[str, float] = {}
moments: dict[str, float] = {}


def tick() -> float | None:
    now = time.monotonic()
    if "enabled" not in moments:
        moments["enabled"] = now
        bpy.ops.preferences.addon_enable(module=MODULE)
        return 1.0
    if "began" not in moments:
        moments["began"] = now
        bpy.ops.wm.open_mainfile(filepath=BLEND)
        moments["read"] = time.monotonic()
        found["open_seconds_window"] = round(moments["read"] - moments["began"], 3)
        watch()
        return 0.01
    if "seen" not in moments:
        return 0.01 if now - moments["read"] < LONGEST_S else quit_blender()
    if "open_to_visible_seconds" not in found:
        found["open_to_visible_seconds"] = round(moments["seen"] - moments["read"], 3)
        write()
        moments["written"] = now
    overlay = import_module(f"{MODULE}.engine.gpu.overlay").overlay
    rested = overlay.resting or now - moments["read"] > LONGEST_S
    if rested and "opened_refined_seconds" not in found:
        found["opened_refined_seconds"] = round(now - moments["read"], 3)
        write()
    return quit_blender() if rested and now - moments["written"] > LOOKED_AT_S else 0.1


def watch() -> None:
    """Note when humans are drawn first."""
    engine = import_module(f"{MODULE}.engine")
    draw = engine._draw_humans

    def drawn() -> None:
        draw()
        overlay = sys.modules.get(f"{MODULE}.engine.gpu.overlay")
        if overlay is not None and any(one.shown is not None for one in overlay.overlay._regions.values()):
            gpu.state.active_framebuffer_get().read_color(0, 0, 1, 1, 4, 0, "UBYTE")  # what was drawn is finished
            moments.setdefault("seen", time.monotonic())

    bpy.types.SpaceView3D.draw_handler_remove(engine._draw_handlers[0], "WINDOW")
    engine._draw_handlers[0] = bpy.types.SpaceView3D.draw_handler_add(drawn, (), "WINDOW", "POST_VIEW")


def write() -> None:
    part = Path(FIGURES).with_suffix(".part")
    part.write_text(json.dumps(found), encoding="utf-8")
    part.replace(FIGURES)


def quit_blender() -> None:
    write()
    bpy.ops.wm.quit_blender()


bpy.app.timers.register(tick, first_interval=1.0, persistent=True)
