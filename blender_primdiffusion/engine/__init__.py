"""The render engine "PrimDiffusion": humans drawn by the backend's marcher, in renders and in the viewport."""

from __future__ import annotations

import sys

import bpy

from .engine import ENGINE, PRIMDIFFUSION_RenderEngine
from .settings import PRIMDIFFUSION_PG_render

CHECK_S = 5.0
"""Between checks on a child that may be idle, which is stopped after a while."""
CLASSES = (PRIMDIFFUSION_PG_render, PRIMDIFFUSION_RenderEngine)


def register() -> None:
    """Register the engine and its settings; starts nothing."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_render = bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_render)
    bpy.app.timers.register(_check_child, first_interval=CHECK_S, persistent=True)


def unregister() -> None:
    """Undo `register` and stop the child; scenes that used the engine return to Blender's default."""
    if bpy.app.timers.is_registered(_check_child):
        bpy.app.timers.unregister(_check_child)
    for module, ending in (("viewport", "stop"), ("studio", "close")):
        if (drawn := sys.modules.get(f"{__package__}.{module}")) is not None:  # imported by the first picture
            getattr(drawn, ending)()
    _reset_scenes()
    del bpy.types.Scene.primdiffusion_render
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


def _check_child() -> float:
    if (studio := sys.modules.get(f"{__package__}.studio")) is not None:  # imported by the first picture
        studio.advance()
    return CHECK_S


def _reset_scenes() -> None:
    for scene in bpy.data.scenes:
        if scene.render.engine == ENGINE:
            scene.render.engine = bpy.types.RenderSettings.bl_rna.properties["engine"].default or "BLENDER_WORKBENCH"
