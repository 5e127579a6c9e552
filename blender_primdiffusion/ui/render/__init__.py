"""The engine's settings in the properties editor."""

from __future__ import annotations

import bpy

from . import engine_panels

CLASSES = (
    engine_panels.PRIMDIFFUSION_PT_marching,
    engine_panels.PRIMDIFFUSION_PT_film,
    engine_panels.PRIMDIFFUSION_PT_passes,
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    engine_panels.join_panels()


def unregister() -> None:
    """Undo `register`."""
    engine_panels.leave_panels()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
