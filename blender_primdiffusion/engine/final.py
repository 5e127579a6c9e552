"""Final renders (F12, animations, command line): one view layer's picture, shown band by band as it is drawn."""

from __future__ import annotations

import time

import bpy

from ..backend.drawing import Drawing
from . import studio
from .camera import camera_view, wanted_region
from .frames import Frame
from .picture import scene_content, solids_file
from .view import PinholeView, blender_depth

ANSWER_S = 0.1
"""Interval at which Blender is asked whether the user has cancelled."""
SHOW_S = 0.2
"""Between updates of the picture in the window, each of which copies all of it."""


class RenderFailed(RuntimeError):
    """The picture could not be drawn; the message is for the user."""


def render_layer(engine: bpy.types.RenderEngine, depsgraph: bpy.types.Depsgraph) -> Drawing:
    """Draw one view layer into the engine's result; returns when it is finished or cancelled by the user.

    Raises RenderFailed, FileNotFoundError for a human without a file, and ValueError for what cannot be drawn.
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
        picture = scene_content(depsgraph, solids_file(depsgraph, studio.frames.folder))
        view = camera_view(camera, depsgraph, size, picture.subject)
        frame = studio.frames.take("final", width, height)
        if not bpy.app.background:
            frame.clear()  # rows that are not drawn yet
        params = {**picture.params(), **view.params(), "region": region, "frame": str(frame.path)}
        drawing = studio.drawing_child().draw(params)
        _follow(engine, drawing, result, frame, view)
        if drawing.error is not None:
            raise RenderFailed(str(drawing.error))
        _fill(result, frame, view)
        finished = True
    finally:
        engine.end_result(result, cancel=not finished, do_merge_results=finished)
    return drawing


def _follow(
    engine: bpy.types.RenderEngine, drawing: Drawing, result: bpy.types.RenderResult, frame: Frame, view: PinholeView
) -> None:
    shown_rows, shown_at = 0, time.monotonic()
    while not drawing.finished:
        news = drawing.wait(ANSWER_S)
        if engine.test_break():
            drawing.cancel()
            if drawing.state != "drawing":
                return  # a child may take a minute to start
        if not news or drawing.finished:
            continue
        engine.update_stats("", _stats(drawing, frame.height))
        engine.update_progress(drawing.rows / frame.height)
        if not bpy.app.background and drawing.rows > shown_rows and time.monotonic() - shown_at > SHOW_S:
            _fill(result, frame, view)
            engine.update_result(result)
            shown_rows, shown_at = drawing.rows, time.monotonic()


def _stats(drawing: Drawing, height: int) -> str:
    if drawing.rows == 0:
        return "Starting the backend" if drawing.state in ("waiting", "starting") else "Drawing the first rows"
    left = f", {drawing.eta_s:.1f} s left" if drawing.eta_s else ""
    return f"Row {drawing.rows} of {height}{left}"


def _fill(result: bpy.types.RenderResult, frame: Frame, view: PinholeView) -> None:
    """Copy the frame into the passes."""
    for render_pass in result.layers[0].passes:
        if render_pass.name == "Combined":
            render_pass.rect.foreach_set(frame.combined)
        elif render_pass.name in ("Depth", "Z"):
            render_pass.rect.foreach_set(blender_depth(frame.depth, view))
