"""Follow work to its end, by a timer while there is a window, by waiting in background mode: the queue's jobs, and
sessions beside it; and release the memory of children that have been idle."""

from __future__ import annotations

import collections
import time
import traceback

import bpy

from ..backend.environment import NOT_INSTALLED
from ..backend.requests import RequestError, Steps, sentence
from ..engine import drawing_child
from ..files.regular_files import printable
from ..places import backend_is_named
from .queue import GONE, Entry, Job, JobOutcome, queue
from .windows import blocking_activity, redraw, window_of


def apply_ready_result() -> None:
    """Run the operator that puts the result into the scene it was requested for."""
    entry = queue.current
    scene = next((scene for scene in bpy.data.scenes if scene.session_uid == entry.scene_uid), None)
    if scene is None and entry.job.undo:
        queue.fail(RequestError(GONE.format(entry.scene), "", "scene"))
        return
    try:
        with window_of(scene):
            bpy.ops.primdiffusion.apply_result()
    except RuntimeError as error:  # the timer must continue, whatever state Blender is in
        traceback.print_exc()
        if queue.current is entry:
            queue.fail(RequestError(f"the result could not enter the scene: {error}", "", "scene"))


class PRIMDIFFUSION_OT_apply_result(bpy.types.Operator):
    """Put the result that is ready into the scene"""

    bl_idname = "primdiffusion.apply_result"
    bl_label = "Apply Result"
    bl_options = {"INTERNAL"}  # no UNDO: the step has the job's name, and a failure that changed nothing makes none

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        cls.poll_message_set("No result is ready")
        return queue.ready

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Failures are shown by the panel, or reported by the operator that waits."""
        job, before = queue.current.job, _data_blocks()
        left_edit_mode = bool(job.undo) and _leave_edit_mode(context)
        outcome = queue.finish(context)
        succeeded = outcome.error is None
        if succeeded and job.undo:
            bpy.ops.ed.undo_push(message=job.undo)
        elif left_edit_mode or _data_blocks() != before:  # by a failure or an exporter; see `blocking_activity`
            bpy.ops.ed.undo_push(message=job.undo or job.label)
        if not succeeded:
            print(f"PrimDiffusion: {outcome.sentence}")
            return {"CANCELLED"}
        return {"FINISHED"}


def _data_blocks() -> set[int]:
    """All data-blocks of the file: undo crashes on those that come or go outside its steps."""
    return {block.session_uid for block in bpy.data.user_map()}


def _leave_edit_mode(context: bpy.types.Context) -> bool:
    """Undo steps made in an edit mode hold only the edited object, not the new human. Whether there was one."""
    in_edit_mode = context.mode.startswith(("EDIT", "PARTICLE"))
    if in_edit_mode:
        bpy.ops.object.mode_set(mode="OBJECT")
    return in_edit_mode


TICK_S = 0.1
WATCH_S = 0.25
_MOST_LINES = 200
"""Lines kept of what the steps have said."""
_PRINT_S = 1.0
"""Seconds between lines of progress on the console in background mode."""


class Reporting:
    """Base of operators whose errors become reports; subclasses define `act`.

    No options: with REGISTER a redo slider would start an expensive job again, and results make their own UNDO step.
    """

    bl_options: set[str] = set()
    described_by: tuple[str, ...] = ()
    """Properties that say what a button does: of the first flag that is set, or of the enum, the description is the
    tooltip; otherwise the docstring is."""

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        for name in cls.described_by:
            value, prop = getattr(properties, name), properties.bl_rna.properties[name]
            if value:
                return (prop.enum_items[value] if isinstance(value, str) else prop).description
        return str(cls.__doc__)

    def given(self, name: str) -> bool:
        """Whether a script or a button has set the property."""
        return self.properties.is_property_set(name)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            return self.act(context)
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
        return {"CANCELLED"}

    def act(self, context: bpy.types.Context) -> set[str]:
        """The operator itself; ValueError and OSError become reports."""
        raise NotImplementedError


def submit(operator: bpy.types.Operator, context: bpy.types.Context, job: Job) -> set[str]:
    """Queue `job` for the scene of `context`; with a window a timer follows it, in background mode this waits.

    A job that needs a backend is rejected where there is none.
    """
    if type(job).result_here is Job.result_here and not backend_is_named():
        operator.report({"ERROR"}, sentence(NOT_INSTALLED))
        return {"CANCELLED"}
    if not bpy.app.background:
        queue.add(context, job)
        schedule_polling()
        return {"FINISHED"}
    outcome = _wait_for(queue.add(context, job))
    if outcome.error is not None:
        operator.report({"ERROR"}, outcome.sentence)
        return {"CANCELLED"}
    print(printable(f"PrimDiffusion: {outcome.notice}"), flush=True)
    return {"FINISHED"}


def schedule_polling() -> None:
    """Have Blender call `follow` until the queue is empty."""
    if not bpy.app.timers.is_registered(follow):
        bpy.app.timers.register(follow, first_interval=TICK_S, persistent=True)


def follow() -> float | None:
    """The timer: one tick of the queue; a result enters the scene as soon as nothing is in the way."""
    changed = queue.tick()
    if queue.ready and not queue.advancing and not blocking_activity():
        apply_ready_result()
        changed = True
    if changed:
        redraw()
    return TICK_S if queue.busy else None


def watch() -> float:
    """The timer between jobs: notice a child that died, end one that has been idle."""
    if queue.busy:
        schedule_polling()
    elif queue.listen() or release_when_idle(time.monotonic()):
        redraw()
    return WATCH_S


def schedule_watchdog() -> None:
    """Have Blender call `watch` from now on."""
    if not bpy.app.background and not bpy.app.timers.is_registered(watch):
        bpy.app.timers.register(watch, first_interval=WATCH_S, persistent=True)


def _wait_for(entry: Entry) -> JobOutcome:
    printed = 0.0
    while queue.last is None or queue.last.entry is not entry:
        if queue.tick() and queue.request is not None and time.monotonic() - printed > _PRINT_S:
            printed = time.monotonic()
            print(printable(f"PrimDiffusion: {queue.request.message}"), flush=True)
        if queue.ready:
            apply_ready_result()
        else:
            time.sleep(TICK_S / 4)
    return queue.last


class StepRunner:
    """Runs the steps of one piece of work at a time, beside the queue. All methods are for Blender's main thread."""

    def __init__(self, busy: str, cancelled: str) -> None:
        """What to say while there is work, and of work that was cancelled."""
        self.message = ""
        self.fraction = 0.0
        self.lines: collections.deque[str] = collections.deque(maxlen=_MOST_LINES)
        """What the work has said, newest last."""
        self.error = ""
        """Why the last one failed, in a sentence."""
        self.notice = ""
        """How the last one ended otherwise."""
        self._steps: Steps | None = None
        self._busy, self._cancelled = busy, cancelled
        self._timer = self._follow  # Blender knows a timer by the object

    @property
    def busy(self) -> bool:
        """Whether there is work."""
        return self._steps is not None

    def start(self, steps: Steps) -> None:
        """Begin at the next tick. Raises ValueError while there is other work."""
        if self.busy:
            raise ValueError(f"{self._busy}: wait for it, or press Cancel")
        self._steps, self.error, self.notice, self.message, self.fraction = steps, "", "", "Starting", 0.0
        self.lines.clear()

    def tick(self) -> bool:
        """Continue; True when something visible changed. At the end `notice` or `error` is set."""
        if self._steps is None:
            return False
        before = (self.message, self.fraction, len(self.lines))
        try:
            step = next(self._steps)
        except StopIteration as done:
            self._steps, self.notice = None, sentence(done.value)
        except (RuntimeError, OSError) as error:
            self._steps, self.error = None, sentence(error)
        else:
            self.message, self.fraction = step.message, step.fraction
            self.lines += step.lines
        return not self.busy or before != (self.message, self.fraction, len(self.lines))

    def cancel(self) -> None:
        """End the work and its processes at once."""
        if self._steps is not None:
            self._steps.close()
            self._steps, self.notice = None, self._cancelled

    def close(self) -> None:
        """As `cancel`, and no timer is left."""
        self.cancel()
        if bpy.app.timers.is_registered(self._timer):
            bpy.app.timers.unregister(self._timer)

    def follow(self, operator: bpy.types.Operator) -> set[str]:
        """The end of an operator that has started the work: errors are reported in background mode."""
        if not bpy.app.background:
            if not bpy.app.timers.is_registered(self._timer):
                bpy.app.timers.register(self._timer, first_interval=TICK_S, persistent=True)
            return {"FINISHED"}
        printed = 0.0
        try:
            while self.busy:
                if self.tick() and self.busy and time.monotonic() - printed > _PRINT_S:
                    printed = time.monotonic()
                    print(printable(f"PrimDiffusion: {self.message}"), flush=True)
                time.sleep(TICK_S / 4)
        finally:
            self.cancel()
        for line in filter(None, (*self.lines, self.notice)):
            print(printable(f"PrimDiffusion: {line}"), flush=True)
        if self.error:
            operator.report({"ERROR"}, self.error)
            return {"CANCELLED"}
        return {"FINISHED"}

    def _follow(self) -> float | None:
        if self.tick():
            redraw()
        return TICK_S if self.busy else None


IDLE_S = 600.0
"""Time without work after which a child is ended, seconds."""


def release_when_idle(now: float) -> bool:
    """End the children that have been idle; whether the one of jobs was ended. `now`: time.monotonic()."""
    drawing_child.end_when_idle(IDLE_S)
    return not queue.busy and now - queue.idle_since >= IDLE_S and queue.release()
