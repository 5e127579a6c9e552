"""The sidebar panel Motion, and Pose Library below the panel Human."""

from __future__ import annotations

import json

import bpy

from ...motion.own_poses import own_poses
from ...scene.actions import action_curves, loops
from ...worker.sentence import sentence
from ..jobs.drawing import draw_lines
from ..manual import draw_manual_button
from .armatures import target_armature
from .pose_pictures import poses_folder
from .settings import FACTS, moves_bones


class _InSidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"


class PRIMDIFFUSION_PT_motion(_InSidebar, bpy.types.Panel):
    """Motion from files and of our own, what it is, and out again."""

    bl_label = "Motion"
    bl_order = 3
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual."""
        draw_manual_button(self.layout, "motion")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.operator("primdiffusion.import_motion", icon="IMPORT")
        layout.operator_menu_enum("primdiffusion.add_motion", "motion", text="Add Built-in Motion", icon="ADD")
        try:
            armature = target_armature(context)
        except ValueError as error:
            draw_lines(layout, sentence(error), "INFO")
            return
        self._draw_action(layout, armature)
        column = layout.column(align=True)
        column.operator("primdiffusion.key_pose", icon="KEY_HLT")
        clear = column.row(align=True)
        clear.enabled = bool(armature.animation_data and armature.animation_data.action)
        clear.operator("primdiffusion.clear_motion", icon="X")
        layout.operator("primdiffusion.export_motion", icon="EXPORT")

    def _draw_action(self, layout: bpy.types.UILayout, armature: bpy.types.Object) -> None:
        action = armature.animation_data.action if armature.animation_data else None
        layout.menu("PRIMDIFFUSION_MT_actions", text=action.name if action else "No Motion", icon="ACTION")
        if action is None:
            return
        box = layout.box().column(align=True)
        for label, text in facts_of(action).items():
            row = box.split(factor=0.4)
            row.label(text=label)
            row.label(text=text, translate=False)
        start, end = action.frame_range
        row = box.split(factor=0.4)
        row.label(text="In the Scene")
        row.label(text=f"{start:g} \N{EN DASH} {end:g}", translate=False)
        if action_curves(armature) is not None:
            layout.operator("primdiffusion.loop_motion", icon="FILE_REFRESH", depress=loops(armature))


class PRIMDIFFUSION_MT_actions(bpy.types.Menu):
    """The motions of this file."""

    bl_label = "Motions"

    def draw(self, _context: bpy.types.Context) -> None:
        """A row for each."""
        actions = [action for action in bpy.data.actions if moves_bones(action)]
        for action in actions:
            self.layout.operator("primdiffusion.use_action", text=action.name, icon="ACTION").action = action.name
        if not actions:
            self.layout.label(text="No motion in this file: import one")


class PRIMDIFFUSION_PT_poses(_InSidebar, bpy.types.Panel):
    """Poses with pictures."""

    bl_label = "Pose Library"
    bl_parent_id = "PRIMDIFFUSION_PT_human"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual."""
        draw_manual_button(self.layout, "posing")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.primdiffusion_motion
        layout.template_icon_view(settings, "pose", show_labels=True, scale=6.0, scale_popup=5.0)
        layout.label(text=settings.pose)
        layout.prop(settings, "amount", slider=True)
        layout.prop(settings, "mirror")
        layout.prop(settings, "only_selected")
        layout.operator("primdiffusion.apply_pose", icon="ARMATURE_DATA")
        row = layout.row(align=True)
        row.operator("primdiffusion.mirror_pose", icon="MOD_MIRROR")
        row.operator("primdiffusion.reset_pose", icon="LOOP_BACK")
        row = layout.row(align=True)
        row.operator("primdiffusion.save_pose", icon="ADD")
        if settings.pose in own_poses(poses_folder()):
            row.operator("primdiffusion.delete_pose", icon="TRASH")


def facts_of(action: bpy.types.Action) -> dict[str, str]:
    """What was found when the motion was imported; nothing for actions of other origin."""
    try:
        found = json.loads(action.get(FACTS, "{}"))
    except (ValueError, TypeError):
        return {}
    return {str(k): str(v) for k, v in found.items()} if isinstance(found, dict) else {}


CLASSES = (PRIMDIFFUSION_PT_motion, PRIMDIFFUSION_MT_actions, PRIMDIFFUSION_PT_poses)
