"""PrimDiffusion for Blender: generate clothed 3D people as volumes that follow an SMPL armature, and render them.

bpy and numpy only; the generator runs in a child process with a Python of its own (see `worker`).
"""

from __future__ import annotations

import atexit


def register() -> None:
    """Called by Blender when the extension is enabled."""
    import bpy

    from . import engine, ui

    engine.register()
    ui.register()
    if not bpy.app.binary_path:
        atexit.register(unregister)


def unregister() -> None:
    """Called by Blender when the extension is disabled, and at its exit; ends the child processes.

    As a Python module it has nobody to call this at exit, and 4.5 then hangs while the engine is the active one: hence
    `atexit`. In the application that would come too late, when Blender's data are gone.
    """
    atexit.unregister(unregister)
    from . import engine, ui

    ui.unregister()
    engine.unregister()
