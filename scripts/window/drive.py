"""Runs inside Blender's window: installs the zip, then plays the scenes of `story.py` from a timer, a step at a time.

A scene is a generator: it yields seconds to wait, or the name of a picture to take of the whole window.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import bpy

sys.path.append(str(Path(__file__).resolve().parent))
ARCHIVE, WANTED, PYTHON, *SCENES = sys.argv[sys.argv.index("--") + 1 :]
MODULE = "bl_ext.user_default.primdiffusion"


def play() -> Iterator[float]:
    """Everything, seconds to wait between steps."""
    import story

    yield 2.0
    bpy.context.preferences.view.show_splash = False
    install()
    yield 0.5
    scenes = [(name, scene) for name, scene in story.SCENES.items() if not SCENES or name in SCENES]
    for name, scene in scenes:
        print(f"scene {name}", flush=True)
        for step in scene(MODULE):
            if isinstance(step, str):
                yield from photograph(step)
            else:
                yield step


def install() -> None:
    """As dragging the zip into the window does."""
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.extensions.package_install_files(filepath=ARCHIVE, repo="user_default", enable_on_install=True)
    bpy.context.preferences.addons[MODULE].preferences.backend_python = PYTHON
    import_module(MODULE)


def photograph(name: str) -> Iterator[float]:
    """Draw the window anew, then save what it shows."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            area.tag_redraw()
    yield 0.6
    wanted = Path(WANTED)
    wanted.with_suffix(".part").write_text(name)
    wanted.with_suffix(".part").rename(wanted)
    while wanted.exists():
        yield 0.1


STEPS = play()
LAST = [time.monotonic()]


def tick() -> float | None:
    """The timer."""
    try:
        return next(STEPS)
    except StopIteration:
        print("the story is over", flush=True)
        code = 0
    except Exception:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    if code:
        import os

        os._exit(code)  # an operator cannot give Blender an exit code
    bpy.ops.wm.quit_blender()
    return None


bpy.app.timers.register(tick, first_interval=2.0, persistent=True)
