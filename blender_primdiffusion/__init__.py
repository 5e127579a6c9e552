"""PrimDiffusion for Blender: generate clothed 3D people as volumes that follow an SMPL armature, and render them.

bpy and numpy only; the generator runs in a child process with a Python of its own (see `worker`).
"""

from __future__ import annotations


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import engine, ui

    engine.register()
    ui.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled; ends the child processes."""
    from . import engine, ui

    ui.unregister()
    engine.unregister()
