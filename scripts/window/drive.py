"""Runs inside Blender's window: installs the zip, then plays the scenes of `scenes.py` from a timer, step by step.

A scene is a generator. It yields seconds to wait, the name of a screenshot to take, or an input:
{"point": [x, y], "click": True} or {"key": "Escape", "times": 1}; figures to be written to a file:
{"figures": {name: value}}; or {"pixels that differ": [name, name], "boxes": [...]}, which gets their number between two
screenshots, for each box [left, top, right, bottom].
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Generator, Iterator
from importlib import import_module
from pathlib import Path

import bpy

sys.path.append(str(Path(__file__).resolve().parent))
ARCHIVE, REQUEST, PYTHON, *SCENES = sys.argv[sys.argv.index("--") + 1 :]
MODULE = f"bl_ext.user_default.{Path(ARCHIVE).name.partition('-')[0]}"


def play() -> Iterator[float]:
    """Play all scenes; yields seconds to wait between steps."""
    import scenes
    from setting_up import set_up_real
    from undo_scenes import undo_and_timers, undo_while_generating
    from viewer_scene import viewer

    scenes_on_request = (set_up_real, undo_and_timers, undo_while_generating, viewer)
    on_request = {scene.__name__: scene for scene in scenes_on_request}
    asked_for = {name: scene for name, scene in on_request.items() if name in SCENES}
    yield 2.0
    install()
    yield 0.5
    for name, scene in {**scenes.SCENES, **asked_for}.items():
        if SCENES and name not in SCENES:
            continue
        print(f"scene {name}", flush=True)
        try:
            yield from perform(scene(MODULE, PYTHON))
        except Exception:  # continue with the other scenes; the exit code reports the failure
            traceback.print_exc()
            FAILED.append(name)


def perform(steps: Generator) -> Iterator[float]:
    answer = None
    while True:
        try:
            step = steps.send(answer)
        except StopIteration:
            return
        answer = None
        if isinstance(step, str):
            yield from photograph(step)
        elif isinstance(step, dict):
            answer = yield from ask(step)
        else:
            yield step


def install() -> None:
    """Install the zip, as dragging it into the window does."""
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.extensions.package_install_files(filepath=ARCHIVE, repo="user_default", enable_on_install=True)
    import_module(MODULE)


def photograph(name: str) -> Iterator[float]:
    """Redraw the windows, then save the screen. Panels that have grown slide for a while."""
    for _ in range(3):
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                area.tag_redraw()
        yield 0.4
    yield from ask({"picture": name, "where": where()})


def where() -> dict[str, list[int]]:
    """Left, top, right, bottom in pixels of the screen: each window, the 3D view, and its sidebar without the shelf."""
    boxes = {}
    windows = bpy.context.window_manager.windows
    full = windows[0].height
    for number, window in enumerate(windows):
        top = full - window.y - window.height
        boxes[f"window {number}"] = [window.x, top, window.x + window.width, top + window.height]
    for area in windows[0].screen.areas:
        if area.type == "VIEW_3D":
            region = next(region for region in area.regions if region.type == "UI")
            for name, part in (("view", area), ("sidebar", region)):
                top = full - part.y - part.height
                boxes[name] = [part.x, top, part.x + part.width, top + part.height]
    return boxes


def ask(what: dict) -> Generator[float, None, object]:
    """Send a request and wait until it is done; returns the answer, if there is one."""
    request = Path(REQUEST)
    request.with_suffix(".part").write_text(json.dumps(what), encoding="utf-8")
    request.with_suffix(".part").rename(request)
    while request.exists():
        yield 0.1
    answer = request.with_suffix(".answer")
    if not answer.exists():
        return None
    found = json.loads(answer.read_text(encoding="utf-8"))
    answer.unlink()
    return found


STEPS = play()
FAILED: list[str] = []
"""Names of scenes."""


def tick() -> float | None:
    try:
        return next(STEPS)
    except StopIteration:
        print(f"all scenes played; failed: {', '.join(FAILED) or 'none'}", flush=True)
        code = 1 if FAILED else 0
    except Exception:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    if code:
        os._exit(code)  # an operator cannot set Blender's exit code
    bpy.ops.wm.quit_blender()
    return None


bpy.app.timers.register(tick, first_interval=2.0, persistent=True)
