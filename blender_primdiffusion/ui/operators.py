"""Generate and Cancel. Neither is redoable: moving a redo slider must not start an expensive job again."""

from __future__ import annotations

import time

import bpy

from .attributes import asked, parsed
from .generation import TICK_S, Busy, GenerationFailed, session
from .properties import SAMPLER_ITEMS

_TOLD_S = 1.0
"""Between lines of progress on the console in background mode."""


class PRIMDIFFUSION_OT_generate(bpy.types.Operator):
    """Generate a person from the seed, and add it to the scene with an armature"""

    bl_idname = "primdiffusion.generate"
    bl_label = "Generate Human"
    bl_options: set[str] = set()  # noqa: RUF012  bpy wants a plain set; neither REGISTER (redo) nor UNDO (session pushes one)

    seed: bpy.props.IntProperty(name="Seed", default=-1, min=-1, description="-1: the panel's")
    steps: bpy.props.IntProperty(name="Steps", default=0, min=0, description="0: the panel's")
    sampler: bpy.props.EnumProperty(
        name="Sampler", items=SAMPLER_ITEMS, description="Not given: the panel's", options={"SKIP_SAVE"}
    )
    guidance: bpy.props.FloatProperty(
        name="Guidance", min=0.0, max=20.0, description="Not given: the panel's", options={"SKIP_SAVE"}
    )
    attributes: bpy.props.StringProperty(
        name="Attributes",
        description="Like sex=female, height=1.7; empty: whatever comes. Not given: the panel's",
        options={"SKIP_SAVE"},
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start; with a window a timer follows the job, in background mode this waits for it."""
        settings = context.scene.primdiffusion
        given = self.properties.is_property_set
        sampler = self.sampler if given("sampler") else settings.sampler
        guidance = self.guidance if given("guidance") else settings.guidance
        try:
            wanted = parsed(self.attributes) if given("attributes") else asked(settings.attributes)
            asked_of_the_child = {"attributes": wanted, "guidance": guidance} if wanted else {}
            session.start(
                self.seed if self.seed >= 0 else settings.seed,
                self.steps or settings.steps,
                sampler,
                asked_of_the_child,
            )
        except (Busy, OSError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return see_through(self, context)


class PRIMDIFFUSION_OT_cancel(bpy.types.Operator):
    """Stop making the person; nothing is added to the scene"""

    bl_idname = "primdiffusion.cancel"
    bl_label = "Cancel"
    bl_options: set[str] = set()  # noqa: RUF012

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only while something runs."""
        return session.busy

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Ask; the timer sees it through."""
        session.cancel()
        return {"FINISHED"}


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
