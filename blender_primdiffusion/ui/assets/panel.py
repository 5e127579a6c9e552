"""The sub-panel Assets of the selected person."""

from __future__ import annotations

import bpy

from ...scene.human import humans
from ...worker.sentence import sentence
from ..jobs.drawing import draw_job, draw_lines
from ..jobs.target import selected_person
from ..manual import draw_manual_button
from ..translations import CONTEXT


class PRIMDIFFUSION_PT_assets(bpy.types.Panel):
    """People and poses for other files."""

    bl_label = "Assets"
    bl_translation_context = CONTEXT
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_parent_id = "PRIMDIFFUSION_PT_human"
    bl_order = 90
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual's page."""
        draw_manual_button(self.layout, "assets")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        try:
            person = selected_person(context) if humans(context.scene) else None
        except ValueError as error:
            draw_lines(layout, sentence(error), "INFO")
            return
        if person is not None and person.asset_data is not None:
            layout.operator("primdiffusion.unmark_human_asset", icon="X")
        else:
            draw_job(layout, "human_asset", "primdiffusion.mark_human_as_asset", "ASSET_MANAGER")
        draw_job(layout, "pose_asset", "primdiffusion.mark_pose_as_asset", "ARMATURE_DATA")
        layout.operator("primdiffusion.make_pose_assets", icon="FILE_FOLDER")
