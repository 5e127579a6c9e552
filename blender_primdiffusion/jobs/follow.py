"""Follow jobs to their end: by a timer while there is a window, by waiting in background mode."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Iterator

import bpy

from .building import building
from .job import Job
from .memory import release_when_idle
from .pictures import so_far
from .queue import GONE, Entry, Outcome, queue
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
    if scene is None and entry.job.undo:
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
    bl_options = {"INTERNAL"}  # noqa: RUF012  not UNDO: the step has the job's own name, and none is made on failure

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only while a result waits."""
        cls.poll_message_set("No result is ready")
        return queue.ready

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Failures are the panel's to show, or of the operator that waits."""
        undo = queue.current.job.undo
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


TICK_S = 0.1
WATCH_S = 0.25
_TOLD_S = 1.0
"""Between lines of progress on the console in background mode."""


def submit(operator: bpy.types.Operator, context: bpy.types.Context, job: Job) -> set[str]:
    """Queue `job` for the scene of `context`; with a window a timer follows it, in background mode this waits."""
    if not bpy.app.background:
        queue.add(context, job)
        keep_following()
        return {"FINISHED"}
    outcome = _wait_for(queue.add(context, job))
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
    changed |= so_far.show(queue.request.picture if queue.request is not None else None)
    if changed:
        redraw()
    if building.busy and not in_the_way():
        return 0.0  # whatever the user does meanwhile comes first all the same
    return TICK_S if queue.busy else None


def watch() -> float:
    """The timer between jobs: notice a child that died, end one that has been idle for long."""
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
    """Draw the sidebars of all windows anew: nothing else tells them that the job has moved on.

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
        if queue.tick() and queue.request is not None and time.monotonic() - printed > _TOLD_S:
            printed = time.monotonic()
            print(f"PrimDiffusion: {queue.request.message}", flush=True)
        if queue.ready:
            enter()
        else:
            time.sleep(TICK_S / 4)
    return queue.last


def _nearer() -> bool:
    """Bring the answer nearer to the scene, and into it at last; True when something visible changed."""
    building.begin(queue.current, queue.request.result or {})
    waits = bool(in_the_way())
    if building.goes_on(may_work=not waits):
        return building.moved()
    if not waits:
        enter()
    return not waits


CLASSES = (PRIMDIFFUSION_OT_take_result,)
