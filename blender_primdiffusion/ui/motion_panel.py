"""The sidebar panel Motion."""

from __future__ import annotations

import dataclasses
import itertools

import bpy
import numpy as np
from bpy_extras.io_utils import ExportHelper

from ..backend.requests import sentence
from ..formats.poses.files import write_amass
from ..motion.built_in_motions import built_in_motion
from ..motion.pose_library import check_posable
from ..scene.actions import action_curves
from ..scene.armature import pose_from_joint_rotations
from ..scene.blend_values import as_shown, stored_record
from ..scene.handles import check_no_handles
from .drawing import SidebarPanel, draw_lines, property_columns
from .export_operators import destination
from .motion_placing import Placement, extend_range, place_motion, sample_motion
from .on_person import FACTS, OnArmature, WhereTo, may_have_joints, scene_fps, target_armature

_MOST_FACTS = 20
_BUILT_IN = [
    ("WALK", "Walk", "An easy walk straight ahead; the feet do not slide"),
    ("IDLE", "Idle", "Standing, breathing, the weight going from leg to leg"),
    ("WAVE", "Wave", "Standing and waving with the right hand"),
    ("TURN", "Turn Left", "A quarter turn to the left in two steps"),
]


class PRIMDIFFUSION_OT_use_action(OnArmature, bpy.types.Operator):
    """Use another action of this file for the human"""

    bl_idname = "primdiffusion.use_action"
    bl_label = "Use Motion"
    bl_options = {"REGISTER", "UNDO"}

    action: bpy.props.StringProperty(
        name="Action", description="Name of the action; empty: none, and the rest pose", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return (
            str(cls.__doc__)
            if properties.action
            else "Remove the motion from the human; the action stays in the file, the human returns to the rest pose"
        )

    def on(self, _context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        check_posable(armature)
        check_no_handles(armature)
        if not self.action:
            _clear_motion(armature)
            return {"FINISHED"}
        action = bpy.data.actions.get(self.action)
        if action is None:
            raise ValueError(f"there is no action {self.action!r} in this file")
        if not moves_bones(action):
            raise ValueError(f"the action {self.action!r} does not animate the bones of a human")
        animation = armature.animation_data_create()
        animation.action = action
        if action_curves(armature) is None:
            animation.action_slot = next(slot for slot in action.slots if slot.target_id_type == "OBJECT")
        return {"FINISHED"}


def _clear_motion(armature: bpy.types.Object) -> None:
    """Remove action and strips, and pose the armature as at rest. Raises ValueError where there are none."""
    animation = armature.animation_data
    if animation is None or (animation.action is None and not animation.nla_tracks):
        raise ValueError(f"{armature.name!r} has no motion to clear")
    animation.action = None
    for track in list(animation.nla_tracks):
        animation.nla_tracks.remove(track)
    pose_from_joint_rotations(armature, np.tile(np.eye(3), (24, 1, 1)))


def moves_bones(action: bpy.types.Action) -> bool:
    """Whether an action turns the pelvis of some armature."""
    return any(
        curve.data_path == 'pose.bones["pelvis"].rotation_quaternion'
        for layer in action.layers
        for strip in layer.strips
        for bag in strip.channelbags
        for curve in bag.fcurves
    )


class PRIMDIFFUSION_OT_add_motion(OnArmature, WhereTo, bpy.types.Operator):
    """Apply a built-in motion to the human"""

    bl_idname = "primdiffusion.add_motion"
    bl_label = "Add Motion"
    bl_options = {"REGISTER", "UNDO"}

    motion: bpy.props.EnumProperty(name="Motion", description="What the human does", items=_BUILT_IN)
    rounds: bpy.props.IntProperty(name="Rounds", description="Number of repetitions", default=2, min=1, max=500)
    speed: bpy.props.FloatProperty(name="Speed", description="2 is twice as fast", default=1.0, min=0.1, max=10.0)

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        rate = scene_fps(context.scene)
        made = dataclasses.replace(built_in_motion(self.motion, self.rounds, rate / self.speed), fps=rate)
        how = Placement(start=self.start, timing="SOURCE", root=self.root, ground=False, into=self.into)
        _, last = place_motion(context, armature, made, how)
        if self.extend:
            extend_range(context.scene, last)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_export_motion(OnArmature, ExportHelper, bpy.types.Operator):
    """Write the human's motion as an AMASS .npz file: axis angles, translations and shape, z up"""

    bl_idname = "primdiffusion.export_motion"
    bl_label = "Export Motion"

    filename_ext = ".npz"
    filter_glob: bpy.props.StringProperty(default="*.npz", options={"HIDDEN"})
    first: bpy.props.IntProperty(
        name="From", description="First frame; if From and To are 0, the scene's range", default=0
    )
    last: bpy.props.IntProperty(name="To", description="Last frame", default=0)

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        scene = context.scene
        first, last = (self.first, self.last) if self.first or self.last else (scene.frame_start, scene.frame_end)
        if last < first:
            raise ValueError(f"the last frame {last} is before the first, {first}: swap them")
        motion, betas, pelvis = sample_motion(context, armature, first, last)
        path = destination(self.filepath, (".npz",))
        write_amass(path, motion, betas, pelvis)
        self.report({"INFO"}, f"{len(motion)} frames of {armature.name!r} written to {path.name!r}")
        return {"FINISHED"}


class PRIMDIFFUSION_PT_motion(SidebarPanel, bpy.types.Panel):
    """Import and built-in motions, the current motion, and export."""

    bl_label = "Motion"
    bl_parent_id = "PRIMDIFFUSION_PT_human"
    bl_order = 2
    bl_options = {"DEFAULT_CLOSED"}
    manual_page = "motion"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return may_have_joints(context)

    def draw(self, context: bpy.types.Context) -> None:
        layout = property_columns(self.layout)
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
        animation = armature.animation_data
        if animation is not None and (animation.action is not None or animation.nla_tracks):
            column.operator("primdiffusion.use_action", text="Clear Motion", icon="X").action = ""
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
            layout.prop(armature.primdiffusion_human, "loop", toggle=True, icon="FILE_REFRESH")


class PRIMDIFFUSION_MT_actions(bpy.types.Menu):
    """The motions of this file."""

    bl_label = "Motions"

    def draw(self, _context: bpy.types.Context) -> None:
        actions = [action for action in bpy.data.actions if moves_bones(action)]
        for action in actions:
            self.layout.operator("primdiffusion.use_action", text=action.name, icon="ACTION").action = action.name
        if not actions:
            self.layout.label(text="No motion in this file: import one")


def facts_of(action: bpy.types.Action) -> dict[str, str]:
    """What was found when the motion was imported; nothing for actions of other origin."""
    found = itertools.islice(stored_record(action, FACTS).items(), _MOST_FACTS)
    return {as_shown(name): as_shown(value) for name, value in found}
