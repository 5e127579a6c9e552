"""Import Motion: the operator, its options, and dropped files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import bpy
from bpy_extras.io_utils import ImportHelper

from ..formats.poses.files import ENDINGS, read_motion
from ..motion.placing import Placement, extend_range, place_motion
from .drawing import property_columns
from .on_person import ArmatureOperator, WhereTo, warn_of_rest

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
            self.report({"WARNING"}, motion.detected.doubt)
        self.report({"INFO"}, f"{motion.name}: {len(motion)} frames of the file on frames {first:g} to {last:g}")
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
