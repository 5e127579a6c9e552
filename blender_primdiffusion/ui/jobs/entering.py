"""The way of a finished work into the scene: when nothing is in the way, in a context that Blender's operators bear."""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Iterator

import bpy

from .queue import GONE, queue
from .remedies import refusal_of_the_scene

_IN_THE_WAY = {"UNDO", "BLOCKING", "GRAB_CURSOR", "GRAB_CURSOR_X", "GRAB_CURSOR_Y"}
"""Options of modal operators that hold on to the scene or the mouse; others (screencasts) may run for ever."""


def in_the_way() -> str:
    """What a result waits for, for people; empty when nothing keeps it from the scene."""
    if bpy.app.is_job_running("RENDER"):
        return "the render"
    windows = bpy.context.window_manager.windows
    for modal in (modal for window in windows for modal in window.modal_operators):
        if _IN_THE_WAY & modal.bl_options:
            return modal.name
    return ""


def enter() -> None:
    """Hand the answer to the operator that puts it into the scene it was asked for."""
    entry = queue.current
    scene = next((scene for scene in bpy.data.scenes if scene.session_uid == entry.scene_uid), None)
    if scene is None and entry.work.undo:
        queue.refuse(refusal_of_the_scene(GONE.format(entry.scene)))
        return
    try:
        with _shown(scene):
            bpy.ops.primdiffusion.take_result()
    except RuntimeError as error:  # the timer must go on, whatever state Blender is in
        traceback.print_exc()
        if queue.current is entry:
            queue.refuse(refusal_of_the_scene(f"the result could not enter the scene: {error}"))


@contextlib.contextmanager
def _shown(scene: bpy.types.Scene | None) -> Iterator[None]:
    """A context with this scene in a window: timers have none of their own.

    Where no window shows the scene, one does for as long as this takes: a context of another scene than its window's
    crashes operators (4.5, 5.0).
    """
    windows = list(bpy.context.window_manager.windows)
    window = next((window for window in windows if window.scene == scene), windows[0] if windows else None)
    if window is None:
        yield
        return
    before = window.scene
    if scene is not None and before != scene:
        window.scene = scene
    try:
        with bpy.context.temp_override(window=window):
            yield
    finally:
        if window.scene != before:
            window.scene = before
