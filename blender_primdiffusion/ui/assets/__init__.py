"""People and poses in Blender's Asset Browser."""

from __future__ import annotations

import bpy

from . import operators, panel

CLASSES = (
    operators.PRIMDIFFUSION_OT_mark_human_as_asset,
    operators.PRIMDIFFUSION_OT_mark_pose_as_asset,
    operators.PRIMDIFFUSION_OT_unmark_human_asset,
    operators.PRIMDIFFUSION_OT_make_pose_assets,
    panel.PRIMDIFFUSION_PT_assets,
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Undo `register`."""
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
