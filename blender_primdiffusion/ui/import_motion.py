"""Import Motion: the operator, its options, and files dropped onto humans."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.io_utils import ImportHelper
from bpy_extras.view3d_utils import location_3d_to_region_2d
from numpy.typing import NDArray

from ..backend.requests import sentence
from ..files.regular_files import FileError
from ..formats.joints import JOINT_NAMES
from ..formats.poses.bvh import bone_names, parse_bvh
from ..formats.poses.files import ENDINGS, read_motion
from ..motion.placing import Placement, extend_range, facts, place_motion
from ..scene.human import humans
from .drawing import draw_lines, property_columns
from .on_person import ArmatureOperator, WhereTo, target_armature, warn_of_rest

_MARGIN = 0.12
"""Margin around the joints' rectangle that still counts as the human, as a share of its height."""


def person_under(context: bpy.types.Context, event: bpy.types.Event) -> str:
    """Name of the human under the mouse in the 3D view, by its joints (rays do not hit volumes); empty for none."""
    region, view = context.region, context.region_data
    if region is None or view is None:
        return ""
    seen = {}
    for person in humans(context.scene):
        bones = [person.pose.bones[name] for name in JOINT_NAMES if name in person.pose.bones]
        spots = [location_3d_to_region_2d(region, view, person.matrix_world @ bone.head) for bone in bones]
        seen[person.name] = np.array([spot for spot in spots if spot is not None]).reshape(-1, 2)
    return nearest_to((event.mouse_region_x, event.mouse_region_y), seen)


def nearest_to(mouse: tuple[float, float], seen: dict[str, NDArray]) -> str:
    """The name whose joints on screen [n, 2], in pixels, surround the mouse; the closest of several."""
    best, name = np.inf, ""
    for person, spots in seen.items():
        if len(spots) == 0:
            continue
        low, high = spots.min(0), spots.max(0)
        margin = _MARGIN * (high - low).max()
        if np.all(mouse >= low - margin) and np.all(mouse <= high + margin):
            apart = float(np.linalg.norm(spots - mouse, axis=-1).min())
            if apart < best:
                best, name = apart, person
    return name


_UP_ITEMS = [
    ("AUTO", "Found in the File", "The axis along which the person stands in most frames"),
    *[
        (axis.upper().replace("-", "MINUS_"), axis.upper(), f"{axis} points up")
        for axis in ("x", "y", "z", "-x", "-y", "-z")
    ],
]


@dataclasses.dataclass(frozen=True)
class FileFacts:
    """Content of a file, shown beside the file browser."""

    facts: dict[str, str]
    bones: tuple[str, ...]
    """Names of the bones in a .bvh."""
    found: dict[str, str]
    """SMPL's joint -> bone, as recognised by name."""
    people: tuple[str, ...] = ()
    """Names of the people in a tracker's output."""
    error: str = ""
    """What is wrong with the file, or what is doubtful."""


def look_at(filepath: str, up: str = "", person: str = "") -> FileFacts:
    """What is in a file; cached until the file changes. Does not raise."""
    path = Path(bpy.path.abspath(filepath))
    if path.suffix.lower() not in ENDINGS or not path.is_file():
        return FileFacts({}, (), {})
    stat = path.stat()
    return _look_at(str(path), up, person, stat.st_mtime_ns, stat.st_size)


@functools.lru_cache(maxsize=8)
def _look_at(path: str, up: str, person: str, _changed: int, _size: int) -> FileFacts:
    bones: tuple[str, ...] = ()
    try:
        if path.lower().endswith(".bvh"):
            bones = tuple(bone_names(parse_bvh(Path(path))))
        motion = read_motion(path, up, person=person)
    except (FileError, OSError) as error:
        return FileFacts({}, bones, {}, error=str(error))
    found = motion.detected
    return FileFacts(facts(motion), bones, dict(found.bones), found.people, found.doubt)


def bone_property(joint: str) -> str:
    """The operator's property that holds the bone for a joint."""
    return f"bone_{joint}"


def _bones_of(self, _context: bpy.types.Context, text: str) -> list[str]:
    return [bone for bone in look_at(self.filepath).bones if text.lower() in bone.lower()]


def _people_of(self, _context: bpy.types.Context, text: str) -> list[str]:
    return [person for person in look_at(self.filepath).people if text.lower() in person.lower()]


class _BoneMap:
    """A field for each of SMPL's joints."""

    __annotations__ = {
        bone_property(joint): bpy.props.StringProperty(
            name=joint.replace("_", " ").title(),
            description=f"The file's bone that is SMPL's {joint}",
            search=_bones_of,
        )
        for joint in JOINT_NAMES
    }


class PRIMDIFFUSION_OT_import_motion(ArmatureOperator, WhereTo, _BoneMap, ImportHelper, bpy.types.Operator):
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
        search=_people_of,
        options={"SKIP_SAVE"},
    )
    fps: bpy.props.FloatProperty(
        name="Source Rate",
        description="Frames per second of the file; 0: as stated in the file",
        default=0,
        min=0,
        max=10000,
    )
    timing: bpy.props.EnumProperty(
        name="Keys",
        description="Where keys are set",
        items=[
            ("SCENE", "Scene Rate", "A key on every frame of the scene; the motion keeps its speed"),
            ("SOURCE", "Every Source Frame", "A key for every frame of the file, on subframes where needed"),
        ],
    )
    first: bpy.props.IntProperty(name="From", description="First frame of the file, counted from 1", default=1, min=1)
    last: bpy.props.IntProperty(name="To", description="Last frame of the file; 0: to its end", default=0, min=0)
    stride: bpy.props.IntProperty(name="Step", description="Take every n-th frame of the file", default=1, min=1)
    scale: bpy.props.FloatProperty(
        name="Scale Path",
        description="Factor on the length of the path; rotations stay",
        default=1.0,
        min=0.0,
        soft_max=10,
    )
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
    bones: bpy.props.EnumProperty(
        name="Bones",
        description="How the bones of a .bvh are identified",
        items=[
            ("AUTO", "By Name", "Known rigs: SMPL, Mixamo, CMU, Unreal, Rigify, Daz and others"),
            ("CHOSEN", "Chosen", "The map below, which can be saved as a preset"),
        ],
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the options of a dropped file at the cursor, for the human there; else open the file browser."""
        if self.filepath:
            self.human = person_under(context, event) or self.human
            title = f"Import {Path(self.filepath).name}"
            return context.window_manager.invoke_props_dialog(self, width=420, title=title, confirm_text="Import")
        return ImportHelper.invoke(self, context, event)

    def run(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        if not self.filepath:
            raise ValueError("no file was chosen: choose an .npz, .npy, .json, .pkl or .bvh file")
        chosen = None
        if self.bones == "CHOSEN":
            chosen = {joint: getattr(self, bone_property(joint)) for joint in JOINT_NAMES}
        motion = read_motion(bpy.path.abspath(self.filepath), self.axis(), chosen, self.tracked_person)
        if self.fps:
            motion = dataclasses.replace(motion, fps=self.fps)
        names = [field.name for field in dataclasses.fields(Placement)]
        how = Placement(**{name: getattr(self, name) for name in names})
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

    def draw(self, context: bpy.types.Context) -> None:
        layout = property_columns(self.layout)
        look = look_at(self.filepath, self.axis(), self.tracked_person)
        self._draw_found(context, look)
        if len(look.people) > 1 or self.tracked_person:
            layout.prop(self, "tracked_person")
        layout.prop(self, "up")
        layout.prop(self, "fps")
        column = layout.column(align=True)
        column.prop(self, "first")
        column.prop(self, "last")
        column.prop(self, "stride")
        layout.prop(self, "into")
        row = layout.column()
        row.enabled = self.into != "APPEND"
        row.prop(self, "start")
        layout.prop(self, "timing")
        layout.prop(self, "root")
        layout.prop(self, "fit_stride")
        layout.prop(self, "scale")
        layout.prop(self, "ground")
        layout.prop(self, "extend")
        if look.bones:
            layout.prop(self, "bones")
            if self.bones == "CHOSEN":
                column = layout.column(align=True)
                for joint in JOINT_NAMES:
                    column.prop(self, bone_property(joint), placeholder=look.found.get(joint, ""))

    def _draw_found(self, context: bpy.types.Context, look: FileFacts) -> None:
        box = self.layout.box().column(align=True)
        try:
            box.label(text=target_armature(context, self.human).name, icon="OUTLINER_OB_ARMATURE")
        except ValueError as error:
            draw_lines(box, sentence(error), "ERROR")
        for label, text in look.facts.items():
            row = box.split(factor=0.4)
            row.label(text=label)
            row.label(text=text, translate=False)
        if look.error:
            draw_lines(box, sentence(look.error), "ERROR")


class PRIMDIFFUSION_FH_motion(bpy.types.FileHandler):
    """AMASS .npz, .pkl of trackers and .bvh onto the human under the cursor, else the selected one."""

    bl_idname = "PRIMDIFFUSION_FH_motion"
    bl_label = "Motion for a Human"
    bl_import_operator = "primdiffusion.import_motion"
    bl_file_extensions = ".npz;.pkl;.bvh"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"
