"""The section Motion of the panel Human."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper

from ..backend.requests import sentence
from ..formats.poses.files import read_motion, write_amass
from ..formats.poses.motion import Motion
from ..motion.placing import FACTS, Placement, extend_range, place_motion, rounds_of, sample_motion, scene_fps
from ..scene.blend_values import as_shown, stored_record
from .drawing import draw_lines
from .export_panel import destination
from .on_person import ArmatureOperator, WhereTo, target_armature

_MOST_FACTS = 20
_BUILT_IN = [
    ("WALK", "Walk", "An easy walk straight ahead; the feet do not slide"),
    ("IDLE", "Idle", "Standing, breathing, the weight going from leg to leg"),
    ("WAVE", "Wave", "Standing and waving with the right hand"),
    ("TURN", "Turn Left", "A quarter turn to the left in two steps"),
]
_FOLDER = Path(__file__).parents[1] / "motion" / "data"


def built_in_motion(name: str) -> Motion:
    """One round of a motion of _BUILT_IN, for average legs."""
    motion = read_motion(_FOLDER / f"{name.lower()}.npz")
    label = next(label for one, label, _ in _BUILT_IN if one == name)
    return dataclasses.replace(motion, name=label, detected=dataclasses.replace(motion.detected, average_legs=True))


class PRIMDIFFUSION_OT_add_motion(ArmatureOperator, WhereTo, bpy.types.Operator):
    """Apply a built-in motion to the human"""

    bl_idname = "primdiffusion.add_motion"
    bl_label = "Add Motion"
    bl_options = {"REGISTER", "UNDO"}

    motion: bpy.props.EnumProperty(name="Motion", description="What the human does", items=_BUILT_IN)
    rounds: bpy.props.IntProperty(name="Rounds", description="Number of repetitions", default=2, min=1, max=500)
    speed: bpy.props.FloatProperty(name="Speed", description="2 is twice as fast", default=1.0, min=0.1, max=10.0)

    def run(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        motion = rounds_of(built_in_motion(self.motion), self.rounds)
        seconds = (len(motion) - 1) / motion.fps / self.speed
        frames = max(1, round(seconds * scene_fps(context.scene)))  # whole, for a loop's end to be its beginning
        motion = dataclasses.replace(motion, fps=(len(motion) - 1) / frames * scene_fps(context.scene))
        how = Placement(start=self.start, root=self.root, ground=False)
        _, last = place_motion(context, armature, motion, how)
        if self.extend:
            extend_range(context.scene, last)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_export_motion(ArmatureOperator, ExportHelper, bpy.types.Operator):
    """Write the human's motion as an AMASS .npz file: axis angles, translations and shape, z up"""

    bl_idname = "primdiffusion.export_motion"
    bl_label = "Export Motion"

    filename_ext = ".npz"
    filter_glob: bpy.props.StringProperty(default="*.npz", options={"HIDDEN"})
    first: bpy.props.IntProperty(
        name="From", description="First frame; if From and To are 0, the scene's range", default=0
    )
    last: bpy.props.IntProperty(name="To", description="Last frame", default=0)

    def run(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        scene = context.scene
        first, last = (self.first, self.last) if self.first or self.last else (scene.frame_start, scene.frame_end)
        if last < first:
            raise ValueError(f"the last frame {last} is before the first, {first}: swap them")
        motion, betas, pelvis = sample_motion(context, armature, range(first, last + 1))
        path = destination(self.filepath, (".npz",))
        write_amass(path, motion, betas, pelvis)
        self.report({"INFO"}, f"{len(motion)} frames of {armature.name!r} written to {path.name!r}")
        return {"FINISHED"}


def draw_motion(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Import and built-in motions, the current motion, and export."""
    layout.operator("primdiffusion.import_motion", icon="IMPORT")
    layout.operator_menu_enum("primdiffusion.add_motion", "motion", text="Add Built-in Motion", icon="ADD")
    try:
        armature = target_armature(context)
    except ValueError as error:
        draw_lines(layout, sentence(error), "INFO")
        return
    _draw_action(layout, armature)
    layout.operator("primdiffusion.export_motion", icon="EXPORT")


def _draw_action(layout: bpy.types.UILayout, armature: bpy.types.Object) -> None:
    action = armature.animation_data.action if armature.animation_data else None
    if bpy.data.actions:
        row = layout.row()
        row.context_pointer_set("animated_id", armature)
        # without an action, the menu is an icon alone
        row.template_action(armature, unlink="action.unlink", text="" if action else "Action")
    if action is None:
        return
    start, end = action.frame_range
    box = layout.box().column(align=True)
    for label, text in {**facts_of(action), "In the Scene": f"{start:g} \N{EN DASH} {end:g}"}.items():
        row = box.split(factor=0.4)
        row.label(text=label)
        row.label(text=text, translate=False)


def facts_of(action: bpy.types.Action) -> dict[str, str]:
    """What was found when the motion was imported; nothing for actions of other origin."""
    found = itertools.islice(stored_record(action, FACTS).items(), _MOST_FACTS)
    return {as_shown(name): as_shown(value) for name, value in found}
