"""The sidebar panel Human: the selected human, and what can be done with it; its section Pose: where the built-in
poses are in Blender's own pose library, and IK handles."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..backend.requests import sentence
from ..jobs.volumes import faults
from ..motion.poses import check_posable
from ..places import backend_is_named
from ..scene.handles import add_handles, bake_handles, has_handles
from ..scene.human import selected_person
from .drawing import SidebarPanel, draw_lines, draw_section
from .edit_panel import draw_edit
from .export_panel import draw_from_file
from .motion_panel import draw_motion
from .on_person import ArmatureOperator, may_have_joints, target_armature, warn_of_rest
from .shape_panel import draw_shape

LIBRARY = "PrimDiffusion"
"""Name of the asset library of poses in the preferences."""
_POSES = Path(__file__).parents[1] / "motion" / "data"


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


class PRIMDIFFUSION_OT_add_handles(ArmatureOperator, bpy.types.Operator):
    """Add handles that hold hands and feet where they are (IK), and poles that elbows and knees point to"""

    bl_idname = "primdiffusion.add_handles"
    bl_label = "Add IK Handles"
    bl_options = {"REGISTER", "UNDO"}

    def run(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        check_posable(armature)
        add_handles(context, armature)
        warn_of_rest(self, armature)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_bake_handles(ArmatureOperator, bpy.types.Operator):
    """Turn the joints as the IK handles show, on every frame where the pose is animated, and remove the handles"""

    bl_idname = "primdiffusion.bake_handles"
    bl_label = "Bake and Remove Handles"
    bl_options = {"REGISTER", "UNDO"}

    def run(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        check_posable(armature)
        bake_handles(context, armature)
        return {"FINISHED"}


def draw_pose(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The way to Blender's pose library, which is in Pose Mode, and IK handles."""
    if context.mode == "POSE":
        row = layout.row()
        row.use_property_split = False  # a button over the whole width
        row.prop(context.space_data, "show_region_asset_shelf", text="Show Poses", toggle=True, icon="ASSET_MANAGER")
        draw_lines(layout, "Click a pose to apply it, drag to blend, right-click to flip it.", "INFO")
    else:
        layout.operator("object.posemode_toggle", text="Pose Mode", icon="POSE_HLT")
        draw_lines(layout, "Poses are in the asset shelf of Pose Mode.", "INFO")
    try:
        armature = target_armature(context)
    except ValueError:
        return
    name = "bake_handles" if has_handles(armature) else "add_handles"
    layout.operator(f"primdiffusion.{name}", icon="CON_KINEMATIC")


def _libraries() -> list[bpy.types.UserAssetLibrary]:
    """Ours, which the preferences may have from an earlier start, or from another folder."""
    libraries = bpy.context.preferences.filepaths.asset_libraries
    return [one for one in libraries if one.name == LIBRARY or one.path == str(_POSES)]


def register() -> None:
    """Add the poses to the asset libraries."""
    if not (ours := _libraries()):
        bpy.context.preferences.filepaths.asset_libraries.new(name=LIBRARY, directory=str(_POSES))
    elif ours[0].path != str(_POSES):
        ours[0].path = str(_POSES)


def unregister() -> None:
    """Take the poses out of the asset libraries."""
    for library in _libraries():
        bpy.context.preferences.filepaths.asset_libraries.remove(library)
