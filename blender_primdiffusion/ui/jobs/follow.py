"""Works seen through to their end: by a timer while there is a window, by waiting in background mode."""

from __future__ import annotations

import time

import bpy

from .building import building
from .entering import enter, in_the_way
from .memory import release_when_idle
from .pictures import so_far
from .queue import Entry, Outcome, queue
from .work import Work

TICK_S = 0.1
WATCH_S = 0.25
_TOLD_S = 1.0
"""Between lines of progress on the console in background mode."""


def submit(operator: bpy.types.Operator, context: bpy.types.Context, work: Work) -> set[str]:
    """Queue `work` for the scene of `context`; with a window a timer follows it, in background mode this waits."""
    if not bpy.app.background:
        queue.add(context, work)
        keep_following()
        return {"FINISHED"}
    outcome = _wait_for(queue.add(context, work))
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
    changed = queue.tick()
    if queue.ready and not queue.advancing:
        changed |= _nearer()
    if not queue.ready:
        building.close()
    changed |= so_far.show(queue.job.picture if queue.job is not None else None)
    if changed:
        redraw()
    if building.busy and not in_the_way():
        return 0.0  # whatever the user does meanwhile comes first all the same
    return TICK_S if queue.busy else None


def watch() -> float:
    """The timer between works: a child that died is noticed, one that nobody has needed for long is ended."""
    if queue.busy:
        keep_following()
    elif queue.listen() or release_when_idle(time.monotonic()):
        redraw()
    return WATCH_S


def keep_watching() -> None:
    """Have Blender call `watch` from now on."""
    if not bpy.app.background and not bpy.app.timers.is_registered(watch):
        bpy.app.timers.register(watch, first_interval=WATCH_S, persistent=True)


def redraw() -> None:
    """Draw the sidebars of all windows anew: nothing else tells them that the work has moved on.

    Not the views beside them, which take long to draw.
    """
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions if area.type == "VIEW_3D" else ():
                if region.type == "UI":
                    region.tag_redraw()


def _wait_for(entry: Entry) -> Outcome:
    printed = 0.0
    while queue.last is None or queue.last.entry is not entry:
        if queue.tick() and queue.job is not None and time.monotonic() - printed > _TOLD_S:
            printed = time.monotonic()
            print(f"PrimDiffusion: {queue.job.message}", flush=True)
        if queue.ready:
            enter()
        else:
            time.sleep(TICK_S / 4)
    return queue.last


def _nearer() -> bool:
    """Bring the answer nearer to the scene, and into it at last; True when something visible changed."""
    building.begin(queue.current, queue.job.result or {})
    waits = bool(in_the_way())
    if building.goes_on(may_work=not waits):
        return building.moved()
    if not waits:
        enter()
    return not waits
