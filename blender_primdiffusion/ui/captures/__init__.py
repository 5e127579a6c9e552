"""Render Captures, and people made from captures."""

from __future__ import annotations

import bpy

from . import (
    operators,
    panel,
    reconstruct_operators,
    reconstruct_panel,
    reconstruct_settings,
    settings,
)
from .session import captures

CLASSES = (
    settings.PRIMDIFFUSION_PG_captures,
    operators.PRIMDIFFUSION_OT_render_captures,
    operators.PRIMDIFFUSION_OT_cancel_captures,
    operators.PRIMDIFFUSION_OT_verify_captures,
    operators.PRIMDIFFUSION_OT_preview_rig,
    panel.PRIMDIFFUSION_PT_captures,
    *panel.SUB_PANELS,
    reconstruct_settings.PRIMDIFFUSION_PG_reconstruct,
    reconstruct_operators.PRIMDIFFUSION_OT_human_from_captures,
    reconstruct_panel.PRIMDIFFUSION_PT_human_from_captures,
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_captures = bpy.props.PointerProperty(type=settings.PRIMDIFFUSION_PG_captures)
    bpy.types.Scene.primdiffusion_reconstruct = bpy.props.PointerProperty(
        type=reconstruct_settings.PRIMDIFFUSION_PG_reconstruct
    )


def unregister() -> None:
    """Undo `register`."""
    captures.close()
    if bpy.app.timers.is_registered(operators.follow):
        bpy.app.timers.unregister(operators.follow)
    del bpy.types.Scene.primdiffusion_reconstruct
    del bpy.types.Scene.primdiffusion_captures
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
