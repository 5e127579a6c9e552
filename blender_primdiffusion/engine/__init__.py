"""The render engine "PrimDiffusion": people drawn by the backend's marcher, in renders and in the viewport."""

from __future__ import annotations

import sys

import bpy

from .engine import ENGINE, PRIMDIFFUSION_RenderEngine
from .settings import PRIMDIFFUSION_PG_render

CLASSES = (PRIMDIFFUSION_PG_render, PRIMDIFFUSION_RenderEngine)


def register() -> None:
    """The engine and its settings; starts nothing."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_render = bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_render)


def unregister() -> None:
    """All of `register` undone, the child ended; scenes that used the engine go back to Blender's default."""
    for module, ending in (("viewport", "stop"), ("studio", "close")):
        if (drawn := sys.modules.get(f"{__package__}.{module}")) is not None:  # imported by the first picture
            getattr(drawn, ending)()
    _leave_scenes()
    del bpy.types.Scene.primdiffusion_render
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


def _leave_scenes() -> None:
    for scene in bpy.data.scenes:
        if scene.render.engine == ENGINE:
            scene.render.engine = bpy.types.RenderSettings.bl_rna.properties["engine"].default or "BLENDER_WORKBENCH"
