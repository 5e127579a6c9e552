"""Works seen through to their end: by a timer while there is a window, by waiting in background mode."""

from __future__ import annotations

import time

import bpy

from ...worker.job import JobError
from .queue import GONE, Entry, Outcome, queue
from .work import Work

TICK_S = 0.1
_TOLD_S = 1.0
"""Between lines of progress on the console in background mode."""
_IN_THE_WAY = {"UNDO", "BLOCKING", "GRAB_CURSOR", "GRAB_CURSOR_X", "GRAB_CURSOR_Y"}
"""Options of modal operators that hold on to the scene or the mouse; others (screencasts) may run for ever."""


def submit(operator: bpy.types.Operator, context: bpy.types.Context, work: Work) -> set[str]:
    """Put `work` in line: with a window a timer sees it through, in background mode this waits for its end."""
    entry = queue.add(context, work)
    if not bpy.app.background:
        keep_following()
        return {"FINISHED"}
    outcome = _wait_for(entry)
    if outcome.error is not None:
        operator.report({"ERROR"}, outcome.sentence)
        return {"CANCELLED"}
    print(f"PrimDiffusion: {outcome.notice}", flush=True)
    return {"FINISHED"}


def keep_following() -> None:
    """Have Blender call `follow` until the line is empty."""
    if not bpy.app.timers.is_registered(follow):
        bpy.app.timers.register(follow, first_interval=TICK_S, persistent=True)


def follow() -> float | None:
    """The timer: one tick of the line; an answer enters the scene as soon as nothing is in the way."""
    if not queue.busy:
        return None
    changed = queue.tick()
    if queue.ready and not _in_the_way():
        _enter()
        changed = True
    if changed:
        redraw()
    return TICK_S if queue.busy else None


def redraw() -> None:
    """Draw the sidebars of all windows anew: nothing else tells them that the work has moved on."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def _wait_for(entry: Entry) -> Outcome:
    told = 0.0
    while queue.last is None or queue.last.entry is not entry:
        if queue.tick() and queue.job is not None and time.monotonic() - told > _TOLD_S:
            told = time.monotonic()
            print(f"PrimDiffusion: {queue.job.message}", flush=True)
        if queue.ready:
            _enter()
        else:
            time.sleep(TICK_S / 4)
    return queue.last


def _in_the_way() -> bool:
    """Blender renders, or the user is moving something."""
    if bpy.app.is_job_running("RENDER"):
        return True
    windows = bpy.context.window_manager.windows
    return any(_IN_THE_WAY & modal.bl_options for window in windows for modal in window.modal_operators)


def _enter() -> None:
    """Hand the answer to the operator that puts it into the scene it was asked for."""
    entry = queue.current
    windows = bpy.context.window_manager.windows
    context: dict[str, object] = {}
    if window := bpy.context.window or next(iter(windows), None):  # timers have no window of their own
        context["window"] = window
    if entry.work.undo:
        scene = next((scene for scene in bpy.data.scenes if scene.session_uid == entry.scene_uid), None)
        if scene is None:
            queue.refuse(JobError(GONE.format(entry.scene), "", "scene"))
            return
        if window is None or window.scene != scene:
            context |= {"scene": scene, "view_layer": scene.view_layers[0]}
    with bpy.context.temp_override(**context):
        bpy.ops.primdiffusion.take_result()
