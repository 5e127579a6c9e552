"""Add a built-in motion, switch between actions, loop, clear, export."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper

from ..translations import CONTEXT
from .armatures import OnArmature, scene_fps
from .options import WhereTo

_BUILT_IN = [
    ("WALK", "Walk", "An easy walk straight ahead; the feet do not slide"),
    ("IDLE", "Idle", "Standing, breathing, the weight going from leg to leg"),
    ("WAVE", "Wave", "Standing and waving with the right hand"),
    ("TURN", "Turn Left", "A quarter turn to the left in two steps"),
]


class PRIMDIFFUSION_OT_add_motion(OnArmature, WhereTo, bpy.types.Operator):
    """Put a built-in motion onto the person"""

    bl_idname = "primdiffusion.add_motion"
    bl_label = "Add Motion"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    motion: bpy.props.EnumProperty(
        name="Motion", translation_context=CONTEXT, description="What the person does", items=_BUILT_IN
    )
    rounds: bpy.props.IntProperty(name="Rounds", description="How often, in a row", default=2, min=1, max=500)
    speed: bpy.props.FloatProperty(name="Speed", description="2 is twice as fast", default=1.0, min=0.1, max=10.0)

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """Make it at the scene's rate and key it."""
        import dataclasses

        from ...motion.built_in_motions import built_in_motion
        from .placing import Placement, extend_range, place_motion

        rate = scene_fps(context.scene)
        made = dataclasses.replace(built_in_motion(self.motion, self.rounds, rate / self.speed), fps=rate)
        how = Placement(start=self.start, timing="SOURCE", root=self.root, ground=False, into=self.into)
        _, last = place_motion(context, armature, made, how)
        if self.extend:
            extend_range(context.scene, last)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_clear_motion(OnArmature, bpy.types.Operator):
    """Take the motion off the person; the action stays in the file, the person goes back to the rest pose"""

    bl_idname = "primdiffusion.clear_motion"
    bl_label = "Clear Motion"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def on(self, _context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """The action and the tracks of the nonlinear animation."""
        from ...motion.pose_library import check_posable
        from ...scene.armature import pose_from_joint_rotations

        check_posable(armature)
        animation = armature.animation_data
        if animation is None or (animation.action is None and not animation.nla_tracks):
            raise ValueError(f"{armature.name!r} has no motion to clear")
        animation.action = None
        for track in list(animation.nla_tracks):
            animation.nla_tracks.remove(track)
        import numpy as np

        pose_from_joint_rotations(armature, np.tile(np.eye(3), (24, 1, 1)))
        return {"FINISHED"}


class PRIMDIFFUSION_OT_loop_motion(OnArmature, bpy.types.Operator):
    """Let the motion go on for ever, or end that again; a walk goes on from where it has got to"""

    bl_idname = "primdiffusion.loop_motion"
    bl_label = "Loop"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def on(self, _context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """Cycles modifiers on all curves, or none."""
        from ...scene.actions import action_curves, end_repeat, loops, repeat

        if action_curves(armature) is None:
            raise ValueError(f"{armature.name!r} has no action to loop: import or add a motion first")
        (end_repeat if loops(armature) else repeat)(armature)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_export_motion(OnArmature, ExportHelper, bpy.types.Operator):
    """Write the person's motion as the .npz files of AMASS: axis-angles, places and shape, z up"""

    bl_idname = "primdiffusion.export_motion"
    bl_label = "Export Motion"
    bl_options: set[str] = set()  # noqa: RUF012  changes nothing

    filename_ext = ".npz"
    filter_glob: bpy.props.StringProperty(default="*.npz", options={"HIDDEN"})
    first: bpy.props.IntProperty(name="From", description="First frame; 0 with To 0: the scene's range", default=0)
    last: bpy.props.IntProperty(name="To", description="Last frame", default=0)

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """Sample the evaluated bones on every frame, write the file."""
        from ...motion.amass_file import write_amass
        from .sampling import sample_motion

        scene = context.scene
        first, last = (self.first, self.last) if self.first or self.last else (scene.frame_start, scene.frame_end)
        if last < first:
            raise ValueError(f"frames {first} to {last} were wanted: give a last frame that is not before the first")
        motion, betas, pelvis = sample_motion(context, armature, first, last)
        path = Path(bpy.path.abspath(self.filepath))
        write_amass(path, motion, betas, pelvis)
        self.report({"INFO"}, f"{len(motion)} frames of {armature.name!r} written to {path.name!r}")
        return {"FINISHED"}


CLASSES = (
    PRIMDIFFUSION_OT_add_motion,
    PRIMDIFFUSION_OT_clear_motion,
    PRIMDIFFUSION_OT_loop_motion,
    PRIMDIFFUSION_OT_export_motion,
)
