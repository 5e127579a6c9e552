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


class PRIMDIFFUSION_OT_take_result(bpy.types.Operator):
    """Put the result that is ready into the scene"""

    bl_idname = "primdiffusion.take_result"
    bl_label = "Take Result"
    bl_options = {"INTERNAL"}  # noqa: RUF012  not UNDO: the step has the work's own name, and none is made on failure

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only while a result waits."""
        cls.poll_message_set("No result waits to enter the scene")
        return queue.ready

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Failures are the panel's to show, or of the operator that waits."""
        undo = queue.current.work.undo
        if undo:
            _leave_edit_mode(context)
        outcome = queue.finish(context)
        if outcome.error is not None:
            print(f"PrimDiffusion: {outcome.sentence}")
            return {"CANCELLED"}
        if undo:
            bpy.ops.ed.undo_push(message=undo)
        return {"FINISHED"}


def _leave_edit_mode(context: bpy.types.Context) -> None:
    """Undo steps made in an edit mode hold what is being edited alone, not the person."""
    if context.mode.startswith(("EDIT", "PARTICLE")):
        bpy.ops.object.mode_set(mode="OBJECT")
