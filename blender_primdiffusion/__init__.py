"""PrimDiffusion for Blender: generate clothed 3D people as volumes that follow an SMPL armature.

bpy and numpy only; the generator runs in a child process with a Python of its own (see `worker`).
"""

from __future__ import annotations


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import ui

    ui.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled; ends the child process."""
    from . import ui

    ui.unregister()
