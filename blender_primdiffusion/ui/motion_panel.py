"""The section Motion of the panel Human: import, built-in motions, export; and dropped files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper, ImportHelper

from ..backend.requests import sentence
from ..formats.poses.files import ENDINGS, read_motion, write_amass
from ..formats.poses.motion import Motion
from ..motion.placing import Placement, extend_range, place_motion, rounds_of, sample_motion, scene_fps
from .drawing import draw_lines, property_columns
from .export_panel import destination
from .on_person import ArmatureOperator, WhereTo, target_armature, warn_of_rest

_UP_ITEMS = [
    ("AUTO", "Found in the File", "The axis along which the person stands in most frames"),
    *[
        (axis.upper().replace("-", "MINUS_"), axis.upper(), f"{axis} points up")
        for axis in ("x", "y", "z", "-x", "-y", "-z")
    ],
]


class PRIMDIFFUSION_OT_import_motion(ArmatureOperator, WhereTo, ImportHelper, bpy.types.Operator):
    """Apply the motion of an AMASS .npz, a pose file, a tracker's .pkl or a .bvh to the human"""

    bl_idname = "primdiffusion.import_motion"
    bl_label = "Import Motion"
    bl_options = {"UNDO", "PRESET"}

    filename_ext = ""
    filepath: bpy.props.StringProperty(
        name="File", description="Path of the motion", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    filter_glob: bpy.props.StringProperty(default=";".join(f"*{s}" for s in ENDINGS), options={"HIDDEN"})
    up: bpy.props.EnumProperty(name="Up Axis", description="Which axis of the file points up", items=_UP_ITEMS)
    tracked_person: bpy.props.StringProperty(
        name="Person in the File",
        description="Whose motion is taken from a file of several people; empty: who is in the most frames",
        options={"SKIP_SAVE"},
    )
    fps: bpy.props.FloatProperty(
        name="Source Rate",
        description="Frames per second of the file; 0: as stated in the file",
        default=0,
        min=0,
        max=10000,
    )
    first: bpy.props.IntProperty(name="From", description="First frame of the file, counted from 1", default=1, min=1)
    last: bpy.props.IntProperty(name="To", description="Last frame of the file; 0: to its end", default=0, min=0)
    fit_stride: bpy.props.BoolProperty(
        name="Fit Stride",
        description="Scale the path to the length of this human's legs, so that the feet do not slide",
        default=True,
    )
    ground: bpy.props.BoolProperty(
        name="Feet on the Floor",
        description="Move the whole motion up or down until the feet stand on the floor",
        default=True,
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the options of a dropped file at the cursor; else open the file browser."""
        if self.filepath:
            title = f"Import {Path(self.filepath).name}"
            return context.window_manager.invoke_props_dialog(self, width=420, title=title, confirm_text="Import")
        return ImportHelper.invoke(self, context, event)

    def run(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        if not self.filepath:
            raise ValueError("no file was chosen: choose an .npz, .npy, .json, .pkl or .bvh file")
        motion = read_motion(bpy.path.abspath(self.filepath), self.axis(), self.tracked_person)
        if self.fps:
            motion = dataclasses.replace(motion, fps=self.fps)
        how = Placement(self.start, self.first, self.last, self.fit_stride, self.root, self.ground)
        first, last = place_motion(context, armature, motion, how)
        if self.extend:
            extend_range(context.scene, last)
        warn_of_rest(self, armature)
        if motion.detected.doubt:
            self.report({"WARNING"}, sentence(motion.detected.doubt))
        found = f"{motion.detected.rig or 'unknown rig'}, {motion.detected.up} up, {motion.fps:.4g} fps"
        self.report({"INFO"}, f"{motion.name} ({found}): {len(motion)} frames on frames {first:g} to {last:g}.")
        return {"FINISHED"}

    def axis(self) -> str:
        """As `read_motion` wants it."""
        return "" if self.up == "AUTO" else self.up.lower().replace("minus_", "-")

    def draw(self, _context: bpy.types.Context) -> None:
        layout = property_columns(self.layout)
        for name in ("up", "tracked_person", "fps", "first", "last", "start", "root", "fit_stride", "ground", "extend"):
            layout.prop(self, name)


class PRIMDIFFUSION_FH_motion(bpy.types.FileHandler):
    """AMASS .npz, .pkl of trackers and .bvh onto the selected human."""

    bl_idname = "PRIMDIFFUSION_FH_motion"
    bl_label = "Motion for a Human"
    bl_import_operator = "primdiffusion.import_motion"
    bl_file_extensions = ".npz;.pkl;.bvh"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


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
        self.report({"INFO"}, f"{len(motion)} frames of {armature.name!r} written to {path.name!r}.")
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
    if action is not None:
        layout.label(text="Frames {:g} \N{EN DASH} {:g}".format(*action.frame_range), translate=False)
