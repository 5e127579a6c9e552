"""Motion and poses: import, built-in motions, the pose library, export."""

from __future__ import annotations

import bpy

from . import file_handlers, import_motion, motion_operators, panels, pose_operators, pose_pictures, settings

CLASSES = (
    *settings.CLASSES,
    import_motion.PRIMDIFFUSION_OT_import_motion,
    *motion_operators.CLASSES,
    *pose_operators.CLASSES,
    file_handlers.PRIMDIFFUSION_FH_motion,
    *panels.CLASSES,
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_motion = bpy.props.PointerProperty(type=settings.PRIMDIFFUSION_PG_motion)


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.Scene.primdiffusion_motion
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
    pose_pictures.free()
