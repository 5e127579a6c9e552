"""PrimDiffusion for Blender: generate clothed 3D humans as volumes that follow an SMPL armature, and render them.

bpy and numpy only; the generator runs in a child process with a Python of its own (see `backend`).
"""

from __future__ import annotations

import atexit


def register() -> None:
    """Called by Blender when the extension is enabled."""
    # here, so that the backend's client can be imported without bpy
    import bpy

    from . import engine, ui  # likewise

    engine.register()
    ui.register()
    if not bpy.app.binary_path:
        atexit.register(unregister)


def unregister() -> None:
    """Called by Blender when the extension is disabled, and at its exit; ends the child processes.

    Blender as a Python module does not call this at exit, and 4.5 then hangs while the engine is active: hence
    `atexit`. In the application that would be too late: Blender's data are freed before.
    """
    from . import engine, ui  # as in `register`

    atexit.unregister(unregister)

    ui.unregister()
    engine.unregister()
