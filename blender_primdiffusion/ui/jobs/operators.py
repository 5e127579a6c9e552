"""What can be done with works: cancel, try again, resume after a restart, and give memory back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy

from . import memory
from .follow import redraw, submit
from .kept import home_of, is_open, meant_for, work_of
from .queue import queue

if TYPE_CHECKING:
    from ...worker.kept_works import KeptWork

_SKIP = {"SKIP_SAVE"}
_RESUME_HERE = "Put these works in line for the scene that is open now, though they were asked for in another file"


class PRIMDIFFUSION_OT_cancel(bpy.types.Operator):
    """Stop this work, or take it out of the line; nothing is added to the scene"""

    bl_idname = "primdiffusion.cancel"
    bl_label = "Cancel"
    bl_options: set[str] = set()  # noqa: RUF012

    number: bpy.props.IntProperty(
        name="Number", description="Of the work in line; 0 is the one under way", min=0, options=_SKIP
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only while something is in line."""
        cls.poll_message_set("Nothing is in line")
        return queue.busy

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Ask; the timer sees it through."""
        if not queue.cancel(self.number):
            which = f"work {self.number} is not in line any more" if self.number else "nothing is under way yet"
            self.report({"ERROR"}, which)
            return {"CANCELLED"}
        redraw()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_try_again(bpy.types.Operator):
    """Ask for the same once more"""

    bl_idname = "primdiffusion.try_again"
    bl_label = "Try Again"
    bl_options: set[str] = set()  # noqa: RUF012

    kind: bpy.props.StringProperty(
        name="Kind", description="Of work, like generate; empty: the last one that ended", options=_SKIP
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only after something has failed."""
        cls.poll_message_set("Nothing has failed")
        return any(outcome.error is not None for outcome in queue.outcomes.values())

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put the failed work in line again, for the scene at hand."""
        outcome = queue.outcomes.get(self.kind) if self.kind else queue.last
        if outcome is None or outcome.error is None:
            why = f"no work {self.kind!r} has failed" if self.kind else "the last work went well"
            self.report({"ERROR"}, why)
            return {"CANCELLED"}
        return submit(self, context, outcome.entry.work)


class _OfWorksLeft:
    """Which of the works that were left; those of one place, or all that the operator is for."""

    bl_options: set[str] = set()  # noqa: RUF012

    blend: bpy.props.StringProperty(
        name="File",
        description="Those asked for in this .blend, whichever is open now. Not given: as the operator says",
        options=_SKIP,
    )
    scene: bpy.props.StringProperty(
        name="Scene", description="Those for this scene of the file; empty: for any", options=_SKIP
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Only where something was left."""
        cls.poll_message_set("No work was left by an earlier Blender or file")
        return bool(queue.kept.left)

    @property
    def names_a_place(self) -> bool:
        """A file is given; that of works asked for in one never saved is the empty name."""
        return self.properties.is_property_set("blend")

    def is_of_the_place(self, kept: KeptWork) -> bool:
        """It was asked for in the file, and scene, that are given."""
        return kept.blend == self.blend and self.scene in ("", kept.scene)


class PRIMDIFFUSION_OT_resume_works(_OfWorksLeft, bpy.types.Operator):
    """Put works that were left in line again: those asked for in the open file, for their scenes"""

    bl_idname = "primdiffusion.resume_works"
    bl_label = "Resume"

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """The tooltip."""
        elsewhere = properties.is_property_set("blend") and not is_open(properties.blend)
        return _RESUME_HERE if elsewhere else str(cls.__doc__)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """In the order in which they were asked for. Those of a file that is not open enter the scene at hand, and
        only when their file is given."""
        taken = queue.kept.take(self.is_of_the_place if self.names_a_place else home_of)
        if not taken:
            self.report({"ERROR"}, _nothing_taken())
            return {"CANCELLED"}
        unknown, states = [], []
        for kept in taken:
            try:
                work = work_of(kept)
            except ValueError as error:
                unknown.append(str(error))
            else:
                states.append(submit(self, context, work, home_of(kept)))
        if unknown:
            self.report({"WARNING"} if states else {"ERROR"}, "; ".join(unknown))
        redraw()
        return {"FINISHED"} if {"FINISHED"} in states else {"CANCELLED"}


def _nothing_taken() -> str:
    places = sorted({meant_for(kept) for kept in queue.kept.left})
    if not places:
        return "another Blender has taken the works meanwhile"
    return f"nothing was left for this file, but for {'; '.join(places)}: open it, or press Resume Here"


class PRIMDIFFUSION_OT_discard_works(_OfWorksLeft, bpy.types.Operator):
    """Forget works that were left"""

    bl_idname = "primdiffusion.discard_works"
    bl_label = "Discard"

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Of all files where none is given."""
        queue.kept.take(self.is_of_the_place if self.names_a_place else lambda _: True)
        redraw()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_release_memory(bpy.types.Operator):
    """End the processes that generate and draw, and so give back what they hold; the next person starts them anew"""

    bl_idname = "primdiffusion.release_memory"
    bl_label = "Release Memory"
    bl_options: set[str] = set()  # noqa: RUF012

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Tell what was freed."""
        try:
            freed = memory.release()
        except RuntimeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, freed)
        redraw()
        return {"FINISHED"}


CLASSES = (
    PRIMDIFFUSION_OT_cancel,
    PRIMDIFFUSION_OT_try_again,
    PRIMDIFFUSION_OT_resume_works,
    PRIMDIFFUSION_OT_discard_works,
    PRIMDIFFUSION_OT_release_memory,
)
