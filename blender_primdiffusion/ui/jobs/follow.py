"""Jobs seen through to their end: by a timer while there is a window, by waiting in background mode."""

from __future__ import annotations

import time

import bpy

from .session import TICK_S, GenerationFailed, session

_TOLD_S = 1.0
"""Between lines of progress on the console in background mode."""


def see_through(operator: bpy.types.Operator, context: bpy.types.Context) -> set[str]:
    """Follow the job that `operator` has just started: with a window by a timer, in background mode by waiting here."""
    if not bpy.app.background:
        bpy.app.timers.register(follow, first_interval=TICK_S, persistent=True)
        return {"FINISHED"}
    told = 0.0
    while (job := session.job) is not None and not job.finished:
        if session.tick() and time.monotonic() - told > _TOLD_S:
            told = time.monotonic()
            print(f"PrimDiffusion: {job.message}", flush=True)
        time.sleep(TICK_S / 4)
    try:
        session.finish(context)
    except GenerationFailed as error:
        operator.report({"ERROR"}, str(error))
        return {"CANCELLED"}
    print(f"PrimDiffusion: {session.notice}", flush=True)
    return {"FINISHED"}


def follow() -> float | None:
    """The timer: one tick of the job; builds the person when it is done, unless a render is reading the scene."""
    if session.job is None:
        return None
    if session.tick():
        redraw()
    if not session.job.finished or bpy.app.is_job_running("RENDER"):
        return TICK_S
    windows = bpy.context.window_manager.windows
    try:
        with bpy.context.temp_override(window=bpy.context.window or windows[0]):  # timers have no window of their own
            session.finish(bpy.context)
    except GenerationFailed as error:
        print(f"PrimDiffusion: {error}")  # the panel's error line shows it
    finally:
        redraw()
    return None


def redraw() -> None:
    """Draw the sidebars anew: nothing else tells them that the job has moved on."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
