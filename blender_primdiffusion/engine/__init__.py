"""The render engine "PrimDiffusion": humans drawn by the backend's marcher, in renders and in the viewport."""

from __future__ import annotations

from collections.abc import Callable

import bpy

from ..scene.human import any_humans
from . import drawing_child, viewport
from .engine import ENGINE, PRIMDIFFUSION_PG_render, PRIMDIFFUSION_RenderEngine
from .gpu import overlay
from .view import view_engine

_draw_handlers: list[object] = []
CLASSES = (PRIMDIFFUSION_PG_render, PRIMDIFFUSION_RenderEngine)


def register() -> None:
    """Register the engine and its settings; starts nothing."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_render = bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_render)
    if not bpy.app.background:
        _draw_handlers.append(bpy.types.SpaceView3D.draw_handler_add(_draw_humans, (), "WINDOW", "POST_VIEW"))
        _draw_handlers.append(bpy.types.SpaceView3D.draw_handler_add(_draw_error, (), "WINDOW", "POST_PIXEL"))
        for name, handler in _handlers():
            getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Undo `register` and stop the child; scenes that used the engine return to Blender's default."""
    while _draw_handlers:
        bpy.types.SpaceView3D.draw_handler_remove(_draw_handlers.pop(), "WINDOW")
    for name, handler in _handlers():
        if handler in getattr(bpy.app.handlers, name):
            getattr(bpy.app.handlers, name).remove(handler)
    overlay.stop()
    drawing_child.close()
    _reset_scenes()
    del bpy.types.Scene.primdiffusion_render
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


def shows_humans(context: bpy.types.Context) -> bool:
    """Whether humans may be drawn into this 3D view over what Blender draws."""
    return context.scene.primdiffusion_render.in_viewports and not by_engine(context) and any_humans()


def by_engine(context: bpy.types.Context) -> bool:
    """Whether the PrimDiffusion engine draws this 3D view."""
    return view_engine(context.scene.render.engine, context.space_data.shading.type) == ENGINE


def _draw_humans() -> None:
    context = bpy.context
    if shows_humans(context):
        overlay.overlay.draw(context)
        return
    overlay.overlay.leave(context.region)
    humans = viewport.below_overlays.pop(context.region.as_pointer(), None)
    if humans is not None and context.space_data.overlay.show_overlays:
        overlay.erase_behind(context, humans)


def _draw_error() -> None:
    if shows_humans(bpy.context):
        overlay.draw_error(bpy.context)


def _handlers() -> list[tuple[str, Callable[..., None]]]:
    any_change = ("frame_change_post", "undo_post", "redo_post", "load_post")
    return [("depsgraph_update_post", _depsgraph_changed), *((name, _scene_changed) for name in any_change)]


@bpy.app.handlers.persistent
def _scene_changed(*_given: object) -> None:
    overlay.overlay.scene_changed()


@bpy.app.handlers.persistent
def _depsgraph_changed(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    overlay.overlay.scene_changed(update.id for update in depsgraph.updates)


def _reset_scenes() -> None:
    for scene in bpy.data.scenes:
        if scene.render.engine == ENGINE:
            scene.render.engine = bpy.types.RenderSettings.bl_rna.properties["engine"].default or "BLENDER_WORKBENCH"
