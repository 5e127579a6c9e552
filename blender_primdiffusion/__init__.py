"""PrimDiffusion for Blender: generate clothed 3D people as volumes that follow an SMPL armature, and render them.

bpy and numpy only; the generator runs in a child process with a Python of its own (see `worker`).
"""

from __future__ import annotations

import atexit


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import engine, ui

    engine.register()
    ui.register()
    atexit.register(unregister)


def unregister() -> None:
    """Called by Blender when the extension is disabled, or at exit; ends the child processes.

    Blender 4.5 as a Python module unregisters nothing by itself, and hangs at exit when our classes are still there
    and the engine is the active one.
    """
    atexit.unregister(unregister)
    from . import engine, ui

    ui.unregister()
    engine.unregister()
