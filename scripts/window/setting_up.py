"""Sets up the real backend in the window, from the package index; runs only on request (`--scenes set_up_real`).

This downloads some hundreds of megabytes to 3 GB. `PRIMDIFFUSION_COMPUTE` is cpu, cuda or apple; not set: automatic.
"""

from __future__ import annotations

import os
import time
from importlib import import_module

import bpy
from panels import sidebar
from press import Steps, press, wait

_STAGES = ("Downloading", "Installing", "Trying")
"""Beginnings of progress messages; a screenshot is taken in the middle of each stage."""
_MOST_S = 2400.0


def set_up_real(module: str, _python: str) -> Steps:
    """Cost, download, cancel, second start, installation, self-test, ready."""
    bpy.context.preferences.system.use_online_access = True
    preferences = bpy.context.preferences.addons[module].preferences
    preferences.compute = os.environ.get("PRIMDIFFUSION_COMPUTE", "automatic").upper()
    yield from sidebar()
    window = _preferences_window(module)
    yield 1.0
    yield "set_up_real_before"
    session = import_module(f"{module}.ui.setup").session
    began = time.monotonic()
    press("primdiffusion.set_up_backend")
    yield from wait(lambda: not session.busy or session.fraction > 0.1, _MOST_S)
    press("primdiffusion.cancel", what="SET_UP")
    yield 1.0
    yield "set_up_real_cancelled"
    press("primdiffusion.set_up_backend")
    for number, stage in enumerate(_STAGES):
        yield from wait(lambda stage=stage: not session.busy or _is_amid(session, stage), _MOST_S)
        if session.busy:
            yield 1.5
            yield f"set_up_real_{number}"
    yield from wait(lambda: not session.busy, _MOST_S)
    print(f"set up in {time.monotonic() - began:.0f} s: {session.notice or session.error}", flush=True)
    yield 1.0
    yield "set_up_real_ready"
    if session.error:
        raise RuntimeError(session.error)
    with bpy.context.temp_override(window=window):
        bpy.ops.wm.window_close()
    yield 0.5


def _is_amid(session, stage: str) -> bool:
    middle = {"Downloading": 0.35, "Installing": 0.75}.get(stage, 0.0)
    return session.fraction >= middle if middle else session.fraction >= 0.9


def _preferences_window(module: str) -> bpy.types.Window:
    bpy.ops.screen.userpref_show("INVOKE_DEFAULT")
    window = bpy.context.window_manager.windows[-1]
    with bpy.context.temp_override(window=window):
        bpy.ops.preferences.addon_show(module=module)
    return window
