"""The one way by which results enter the scene."""

from __future__ import annotations

import bpy

from .queue import queue


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
