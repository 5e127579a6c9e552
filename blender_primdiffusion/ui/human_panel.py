"""The sidebar panel Human: the selected human, and what can be done with it."""

from __future__ import annotations

import bpy

from ..backend.requests import sentence
from ..jobs.volumes import faults
from ..places import backend_is_named
from ..scene.human import selected_person
from .drawing import SidebarPanel, draw_lines, draw_section
from .edit_panel import draw_edit
from .export_panel import draw_from_file
from .motion_panel import draw_motion
from .on_person import may_have_joints
from .pose_panel import draw_pose
from .shape_panel import draw_shape


class PRIMDIFFUSION_PT_human(SidebarPanel, bpy.types.Panel):
    """Who is selected, by name; shape, pose, motion and edits in closed sections."""

    bl_label = "Human"
    bl_order = 1
    manual_page = "editing"

    def draw(self, context: bpy.types.Context) -> None:
        layout, person = self.layout, None
        if not backend_is_named():  # nor is there the panel Generate
            draw_from_file(layout)
        if faults.text:
            draw_lines(layout, faults.text, "ERROR")
        try:
            person = selected_person(context)
            layout.prop(person, "name", text="", icon="OUTLINER_OB_ARMATURE")
        except ValueError as error:
            draw_lines(layout, sentence(error), "INFO")
        for there, text, page, section, draw in (
            (person is not None, "Shape", "editing", "shape", draw_shape),
            (may_have_joints(context), "Pose", "posing", "", draw_pose),
            (may_have_joints(context), "Motion", "motion", "", draw_motion),
            (person is not None and backend_is_named(), "Edit", "editing", "edits", draw_edit),
        ):
            body = draw_section(layout, text.lower(), text=text, page=page, section=section) if there else None
            if body is not None:
                draw(body, context)
