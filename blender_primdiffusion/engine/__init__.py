"""The render engine "PrimDiffusion": people drawn by the backend's marcher, in renders and in the viewport."""

from __future__ import annotations

import atexit

import bpy

from . import studio, viewport
from .engine import ENGINE, PRIMDIFFUSION_RenderEngine
from .settings import PRIMDIFFUSION_PG_render

CLASSES = (PRIMDIFFUSION_PG_render, PRIMDIFFUSION_RenderEngine)


def register() -> None:
    """The engine and its settings; starts nothing."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_render = bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_render)
    atexit.register(_at_exit)


def unregister() -> None:
    """All of `register` undone, the child ended; scenes that used the engine go back to Blender's default."""
    atexit.unregister(_at_exit)
    viewport.stop()
    studio.close()
    _leave_scenes()
    del bpy.types.Scene.primdiffusion_render
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


def _leave_scenes() -> None:
    for scene in bpy.data.scenes:
        if scene.render.engine == ENGINE:
            scene.render.engine = bpy.types.RenderSettings.bl_rna.properties["engine"].default or "BLENDER_WORKBENCH"


def _at_exit() -> None:
    """Blender 4.5 as a Python module hangs at exit while a Python engine is the active one."""
    studio.close()
    _leave_scenes()
    bpy.utils.unregister_class(PRIMDIFFUSION_RenderEngine)
