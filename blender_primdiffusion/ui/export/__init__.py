"""People as files for other programs, and people from files."""

from __future__ import annotations

import bpy

from . import file_handler, operators, panel, settings

CLASSES = (
    settings.PRIMDIFFUSION_PG_export,
    *operators.CLASSES,
    panel.PRIMDIFFUSION_PT_export,
    panel.PRIMDIFFUSION_PT_export_mesh,
    panel.PRIMDIFFUSION_PT_export_volumes,
    file_handler.PRIMDIFFUSION_FH_human,
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_export = bpy.props.PointerProperty(type=settings.PRIMDIFFUSION_PG_export)


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.Scene.primdiffusion_export
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
