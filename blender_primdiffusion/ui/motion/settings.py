"""What the Motion and Pose Library panels hold."""

from __future__ import annotations

import bpy

from ...scene.actions import action_curves
from ..translations import CONTEXT
from .armatures import target_armature
from .pose_pictures import pose_items

FACTS = "primdiffusion_motion"
"""Custom property of an action: what its motion is, as JSON."""


class PRIMDIFFUSION_PG_motion(bpy.types.PropertyGroup):
    """Of a scene."""

    pose: bpy.props.EnumProperty(name="Pose", description="The pose to apply", items=pose_items)
    amount: bpy.props.FloatProperty(
        name="Amount",
        description="How much of the pose: 0 none, 1 all",
        default=1.0,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    mirror: bpy.props.BoolProperty(name="Mirror", description="Left and right change places", default=False)
    only_selected: bpy.props.BoolProperty(
        name="Only Selected Bones",
        translation_context=CONTEXT,
        description="Leave bones alone that are not selected",
        default=False,
    )


class PRIMDIFFUSION_OT_use_action(bpy.types.Operator):
    """Let the person move by another action of this file"""

    bl_idname = "primdiffusion.use_action"
    bl_label = "Use Motion"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    action: bpy.props.StringProperty(name="Action", description="Name of the action", options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Give the armature the action and a slot of it that fits."""
        from ...motion.pose_library import check_posable

        action = bpy.data.actions.get(self.action)
        try:
            armature = target_armature(context)
            check_posable(armature)
            if action is None:
                raise ValueError(f"there is no action {self.action!r} in this file")
            if not moves_bones(action):
                raise ValueError(f"the action {self.action!r} moves no bones of a person")
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        animation = armature.animation_data_create()
        animation.action = action
        if action_curves(armature) is None:
            animation.action_slot = next(slot for slot in action.slots if slot.target_id_type == "OBJECT")
        return {"FINISHED"}


def moves_bones(action: bpy.types.Action) -> bool:
    """Whether an action turns the pelvis of some armature."""
    return any(
        curve.data_path == 'pose.bones["pelvis"].rotation_quaternion'
        for layer in action.layers
        for strip in layer.strips
        for bag in strip.channelbags
        for curve in bag.fcurves
    )


CLASSES = (PRIMDIFFUSION_PG_motion, PRIMDIFFUSION_OT_use_action)
