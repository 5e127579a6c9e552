"""Add IK handles, and bake and remove them; their button in the panel Pose Library."""

from __future__ import annotations

import bpy

from ..motion.pose_library import check_posable
from ..scene.handles import add_handles, bake_handles, has_handles
from .on_person import OnArmature, target_armature, warn_of_rest


class PRIMDIFFUSION_OT_add_handles(OnArmature, bpy.types.Operator):
    """Add handles that hold hands and feet where they are (IK), and poles that elbows and knees point to"""

    bl_idname = "primdiffusion.add_handles"
    bl_label = "Add IK Handles"
    bl_options = {"REGISTER", "UNDO"}

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        check_posable(armature)
        add_handles(context, armature)
        warn_of_rest(self, armature)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_bake_handles(OnArmature, bpy.types.Operator):
    """Turn the joints as the IK handles show, on every frame where the pose is animated, and remove the handles"""

    bl_idname = "primdiffusion.bake_handles"
    bl_label = "Bake and Remove Handles"
    bl_options = {"REGISTER", "UNDO"}

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        check_posable(armature)
        bake_handles(context, armature)
        return {"FINISHED"}


def draw_handles(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The button that adds handles, or the one that bakes them."""
    try:
        armature = target_armature(context)
    except ValueError:
        return
    name = "bake_handles" if has_handles(armature) else "add_handles"
    layout.operator(f"primdiffusion.{name}", icon="CON_KINEMATIC")
