"""Paint Region, Finish Painting: a region of the person as a vertex group of the body mesh."""

from __future__ import annotations

import bpy

from ...scene.human import BODY_MARK, body_of
from ..jobs.target import selected_person


class PRIMDIFFUSION_OT_paint_region(bpy.types.Operator):
    """Show the body mesh of the selected person and paint on it where to change them"""

    bl_idname = "primdiffusion.paint_region"
    bl_label = "Paint Region"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """To Weight Paint mode, with the panel's vertex group, made if there is none."""
        from ...scene.painting import start_painting

        settings = context.scene.primdiffusion_edit
        try:
            person = selected_person(context)
            body = body_of(person)
            if body is None:
                raise ValueError(f"the body mesh of {person.name!r} was deleted: choose parts by name instead")
            start_painting(context, body, settings.vertex_group)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        settings.region = "PAINTED"
        return {"FINISHED"}


class PRIMDIFFUSION_OT_finish_painting(bpy.types.Operator):
    """Back to Object mode; the body mesh is hidden again, its vertex group stays"""

    bl_idname = "primdiffusion.finish_painting"
    bl_label = "Finish Painting"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only while a body mesh is painted."""
        cls.poll_message_set("No region is being painted: press Paint Region first")
        return painting(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The active object is the body mesh."""
        from ...scene.painting import end_painting

        end_painting(context, context.view_layer.objects.active)
        return {"FINISHED"}


def painting(context: bpy.types.Context) -> bool:
    """A person's body mesh is being weight painted."""
    active = context.view_layer.objects.active
    return active is not None and active.mode == "WEIGHT_PAINT" and BODY_MARK in active
