"""The panel Variations: a contact sheet to choose people from before they are built."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from . import icons, operators, panel, settings, sheet

CLASSES = (
    settings.PRIMDIFFUSION_PG_variations,
    operators.PRIMDIFFUSION_OT_variations,
    operators.PRIMDIFFUSION_OT_more_like_variation,
    operators.PRIMDIFFUSION_OT_select_variation,
    operators.PRIMDIFFUSION_OT_build_variation,
    operators.PRIMDIFFUSION_OT_use_variation_seed,
    operators.PRIMDIFFUSION_OT_clear_variations,
    panel.PRIMDIFFUSION_PT_variations,
)


@persistent
def clear_before_loading(*_: object) -> None:
    """Handler of load_pre: the sheet belongs to what was being worked on."""
    sheet.sheet.clear()
    icons.icons.free()


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_variations = bpy.props.PointerProperty(type=settings.PRIMDIFFUSION_PG_variations)
    bpy.app.handlers.load_pre.append(clear_before_loading)


def unregister() -> None:
    """Undo `register`."""
    if clear_before_loading in bpy.app.handlers.load_pre:  # 5.2 clears them before it disables extensions at exit
        bpy.app.handlers.load_pre.remove(clear_before_loading)
    clear_before_loading()
    del bpy.types.Scene.primdiffusion_variations
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
