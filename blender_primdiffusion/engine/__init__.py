"""The render engine "PrimDiffusion": people drawn by the backend's marcher, in renders and in the viewport."""

from __future__ import annotations

import sys

import bpy

from .engine import ENGINE, PRIMDIFFUSION_RenderEngine
from .settings import PRIMDIFFUSION_PG_render

LOOK_AFTER_S = 5.0
"""Between two looks at a child that nothing is asked of: it is ended when it has been idle for long."""
CLASSES = (PRIMDIFFUSION_PG_render, PRIMDIFFUSION_RenderEngine)


def register() -> None:
    """The engine and its settings; starts nothing."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_render = bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_render)
    bpy.app.timers.register(_look_after, first_interval=LOOK_AFTER_S, persistent=True)


def unregister() -> None:
    """All of `register` undone, the child ended; scenes that used the engine go back to Blender's default."""
    if bpy.app.timers.is_registered(_look_after):
        bpy.app.timers.unregister(_look_after)
    for module, ending in (("viewport", "stop"), ("studio", "close")):
        if (drawn := sys.modules.get(f"{__package__}.{module}")) is not None:  # imported by the first picture
            getattr(drawn, ending)()
    _leave_scenes()
    del bpy.types.Scene.primdiffusion_render
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


def _look_after() -> float:
    if (studio := sys.modules.get(f"{__package__}.studio")) is not None:  # imported by the first picture
        studio.advance()
    return LOOK_AFTER_S


def _leave_scenes() -> None:
    for scene in bpy.data.scenes:
        if scene.render.engine == ENGINE:
            scene.render.engine = bpy.types.RenderSettings.bl_rna.properties["engine"].default or "BLENDER_WORKBENCH"
