"""The panel of the person who is selected."""

from __future__ import annotations

import bpy

from . import (
    edit_operators,
    edit_painting,
    edit_panel,
    edit_settings,
    panel,
    people_operators,
    shape_operators,
    shape_panel,
    shape_settings,
    unused_files,
)

CLASSES = (
    panel.PRIMDIFFUSION_MT_people,
    panel.PRIMDIFFUSION_PT_human,
    shape_settings.PRIMDIFFUSION_PG_human,
    edit_settings.PRIMDIFFUSION_PG_edit,
    *people_operators.PEOPLE,
    *shape_operators.SHAPES,
    *edit_operators.EDITS,
    edit_painting.PRIMDIFFUSION_OT_paint_region,
    edit_painting.PRIMDIFFUSION_OT_finish_painting,
    unused_files.PRIMDIFFUSION_OT_remove_unused_files,
    shape_panel.PRIMDIFFUSION_PT_shape,
    shape_panel.PRIMDIFFUSION_PT_details,
    *edit_panel.SUB_PANELS,
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_edit = bpy.props.PointerProperty(type=edit_settings.PRIMDIFFUSION_PG_edit)
    bpy.types.Object.primdiffusion_human = bpy.props.PointerProperty(type=shape_settings.PRIMDIFFUSION_PG_human)


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.Object.primdiffusion_human
    del bpy.types.Scene.primdiffusion_edit
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
