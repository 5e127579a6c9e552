"""The panel Generate Human."""

from __future__ import annotations

import bpy

from . import attributes, operators, panel, presets, settings

CLASSES = (
    attributes.PRIMDIFFUSION_PG_attributes,
    settings.PRIMDIFFUSION_PG_settings,
    operators.PRIMDIFFUSION_OT_generate,
    operators.PRIMDIFFUSION_OT_random_seed,
    presets.PRIMDIFFUSION_PT_generate_presets,
    presets.PRIMDIFFUSION_OT_add_generate_preset,
    presets.PRIMDIFFUSION_OT_use_generate_preset,
    panel.PRIMDIFFUSION_PT_generate,
    panel.PRIMDIFFUSION_PT_attributes,
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion = bpy.props.PointerProperty(type=settings.PRIMDIFFUSION_PG_settings)


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.Scene.primdiffusion
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
    presets.PRIMDIFFUSION_PT_generate_presets.bl_label = presets.NO_PRESET
