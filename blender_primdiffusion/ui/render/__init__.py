"""How people are drawn: the Render panel, and the engine's settings in the properties editor."""

from __future__ import annotations

import bpy

from . import engine_panels, panel, person_operators, scene_operators, settings

CLASSES = (
    engine_panels.PRIMDIFFUSION_PT_marching,
    engine_panels.PRIMDIFFUSION_PT_film,
    engine_panels.PRIMDIFFUSION_PT_passes,
    settings.PRIMDIFFUSION_PG_merging,
    *person_operators.OPERATORS,
    *scene_operators.OPERATORS,
    *panel.PANELS,
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_merging = bpy.props.PointerProperty(type=settings.PRIMDIFFUSION_PG_merging)
    bpy.types.Collection.primdiffusion_density_gain = settings.gain_property()
    engine_panels.join_panels()


def unregister() -> None:
    """Undo `register`."""
    engine_panels.leave_panels()
    del bpy.types.Collection.primdiffusion_density_gain
    del bpy.types.Scene.primdiffusion_merging
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
