"""People and poses in Blender's Asset Browser."""

from __future__ import annotations

import bpy

from ..jobs.work import register_kind, unregister_kind
from . import operators, panel

CLASSES = (
    operators.PRIMDIFFUSION_OT_mark_human_as_asset,
    operators.PRIMDIFFUSION_OT_mark_pose_as_asset,
    operators.PRIMDIFFUSION_OT_unmark_human_asset,
    operators.PRIMDIFFUSION_OT_make_pose_assets,
    panel.PRIMDIFFUSION_PT_assets,
)
WORKS = {"human_asset": "HumanAssetWork", "pose_asset": "PoseAssetWork"}
"""Of work, by kind."""


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    for kind, work in WORKS.items():
        register_kind(kind, f"{__name__}.work:{work}")


def unregister() -> None:
    """Undo `register`."""
    for kind in WORKS:
        unregister_kind(kind)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
