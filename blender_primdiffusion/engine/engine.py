"""The render engine as Blender calls it, final renders (F12, animations, command line), and settings of the scene."""

from __future__ import annotations

import time

import bpy

from ..backend.requests import ChildRequest
from ..formats.requests import RAY_STEP
from . import drawing_child
from .drawing_child import Frame, frames
from .picture import scene_content, scene_solids, stored
from .view import ENGINE, PinholeView, blender_depth, camera_view, wanted_region
from .viewport import Viewport

LISTEN_S = 0.01
"""Between two looks at the child, and at whether the user has cancelled."""


class PRIMDIFFUSION_RenderEngine(bpy.types.RenderEngine):
    """Draws humans exactly, by marching rays through their primitives, and solid objects with simple shading."""

    bl_idname = ENGINE
    bl_label = "PrimDiffusion"
    bl_use_preview = False
    bl_use_postprocess = True
    bl_use_shading_nodes_custom = False
    bl_use_eevee_viewport = True

    def __init__(self, *args: object, **kwargs: object):
        super().__init__(*args, **kwargs)  # without it Blender draws nothing
        self._viewport: Viewport | None = None

    def update_render_passes(self, scene: bpy.types.Scene, renderlayer: bpy.types.ViewLayer) -> None:
        """Combined always, Depth where the view layer has the Z pass."""
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, "Depth", 1, "Z", "VALUE")

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """One view layer of one frame, in a thread of Blender's, in its main one under -b. Errors end the render."""
        try:
            render_layer(self, depsgraph)
        except (ValueError, OSError) as error:
            self._fail(str(error))
        except Exception as error:
            self._fail(f"defect in the engine: {type(error).__name__}: {error}")
            raise

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Called when the scene has changed."""
        self._viewport = self._viewport or Viewport()
        self._viewport.update(context, depsgraph)

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Draw the newest picture, without waiting for one."""
        if self._viewport is None:
            self._viewport = Viewport()
            self._viewport.update(context, depsgraph)
        self._viewport.draw(self, context, depsgraph)

    def _fail(self, message: str) -> None:
        message = f"PrimDiffusion: {message}"
        self.update_stats("", message)
        self.report({"ERROR"}, message)  # ends animations too; after error_set they would continue


def _redraw(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """Blender notifies viewports only of changes to its own data."""
    settings.id_data.update_tag()


class PRIMDIFFUSION_PG_render(bpy.types.PropertyGroup):
    """`scene.primdiffusion_render`."""

    __slots__ = ()
    step: bpy.props.FloatProperty(
        name="Step",
        description="Distance between samples along a ray: smaller is slower and finer",
        subtype="DISTANCE",
        unit="LENGTH",
        default=RAY_STEP,
        min=0.0005,
        max=0.05,
        soft_min=0.001,
        soft_max=0.016,
        step=0.1,
        precision=4,
        update=_redraw,
    )
    view: bpy.props.EnumProperty(
        name="View",
        description="What renders show of humans; 3D views show Colour",
        items=(
            ("COLOUR", "Colour", "Humans as they look"),
            ("DEPTH", "Depth", "Near is bright"),
            ("ALPHA", "Alpha", "How opaque the humans are"),
            ("BOXES", "Primitives", "The boxes that humans are made of, shaded, each in a different colour"),
        ),
        default="COLOUR",
        update=_redraw,
    )
    in_viewports: bpy.props.BoolProperty(
        name="Humans",
        description="Show generated humans in 3D views as the PrimDiffusion engine draws them, wherever their volumes "
        "are hidden",
        default=True,
        update=_redraw,
    )


def render_layer(engine: bpy.types.RenderEngine, depsgraph: bpy.types.Depsgraph) -> ChildRequest:
    """Draw one view layer into the engine's result; returns when it is finished or cancelled by the user.

    Raises ChildProcessError with the child's error, FileNotFoundError for a human without a file, and ValueError for
    what cannot be drawn.
    """
    scene = depsgraph.scene
    camera = engine.camera_override or scene.camera
    if camera is None:
        raise ValueError("the scene has no camera; add one")
    size = (engine.resolution_x, engine.resolution_y)
    region = wanted_region(scene.render, size)
    width, height = region[2:] if region else size
    result = engine.begin_result(0, 0, width, height, layer=depsgraph.view_layer_eval.name)
    finished = False
    try:
        picture = scene_content(depsgraph, stored(scene_solids(depsgraph), frames.folder))
        view = camera_view(camera, depsgraph, size, picture.subject)
        frame = frames.take(width, height)
        params = {**picture.params(), **view.params(), "region": region, "frame": str(frame.path)}
        request = drawing_child.draw(params)
        _follow(engine, request)
        if request.error is not None:
            raise ChildProcessError(str(request.error))
        _fill(result, frame, view)
        finished = True
    finally:
        engine.end_result(result, cancel=not finished, do_merge_results=finished)
    return request


def _follow(engine: bpy.types.RenderEngine, request: ChildRequest) -> None:
    while not request.finished:
        if engine.test_break():
            request.cancel()
        if not request.tick():
            time.sleep(LISTEN_S)
            continue
        engine.update_stats("", _stats(request))
        engine.update_progress(request.fraction)


def _stats(request: ChildRequest) -> str:
    if request.state != "running":
        return request.message
    if request.step == 0:
        return "Drawing the first rows"
    left = f", {request.eta_s:.1f} s left" if request.eta_s else ""
    return f"Row {request.step} of {request.total}{left}"


def _fill(result: bpy.types.RenderResult, frame: Frame, view: PinholeView) -> None:
    """Copy the frame into the passes."""
    for render_pass in result.layers[0].passes:
        if render_pass.name == "Combined":
            render_pass.rect.foreach_set(frame.combined)
        elif render_pass.name in ("Depth", "Z"):
            render_pass.rect.foreach_set(blender_depth(frame.depth, view))
