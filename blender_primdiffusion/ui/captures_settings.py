"""What the panel Render Captures asks for; saved with the scene."""

from __future__ import annotations

import json
import math
from pathlib import Path

import bpy

from ..capture.cameras import view_of
from ..capture.settings import CaptureSettings
from ..formats.camera_rig import Rig
from ..formats.requests import PASSES
from ..scene.blend_values import setting_path
from .declared import declared

_PASS_NAMES = {
    "img": ("Colour", "What the camera sees, over black"),
    "mask": ("Mask", "Coverage of each pixel by the person"),
    "depth": ("Depth", "Metres along the optical axis, 16 bits"),
    "normal": ("Normal", "Surface normal in world space"),
    "part": ("Part", "Which of the 24 joints moves the surface"),
}
_FLAGS = ("denoise", "float_depth", "released_reference")
_PASS_ITEMS = [(kind, *_PASS_NAMES[kind], 1 << i) for i, kind in enumerate(PASSES)]


def _angle(name: str, description: str, default: float, limits: tuple[float, float]) -> object:
    """A property of degrees."""
    least, most = map(math.radians, limits)
    return bpy.props.FloatProperty(
        name=name, description=description, default=math.radians(default), min=least, max=most, subtype="ANGLE"
    )


_DECLARED = (
    "seed", "body", "together", "samples", "light", "denoise", "device", "background", "float_depth",
    "released_reference",
)  # fmt: skip


class _Declared:
    """What the record of a capture declares as the panel has it."""

    __annotations__ = {name: declared(CaptureSettings, name) for name in _DECLARED}


class PRIMDIFFUSION_PG_captures(_Declared, bpy.types.PropertyGroup):
    """`scene.primdiffusion_captures`."""

    people: bpy.props.StringProperty(
        name="People", description="Folder of scans (.glb, .fbx, .obj) or of generated humans", subtype="DIR_PATH"
    )
    out: bpy.props.StringProperty(
        name="Captures", description="Folder of the dataset; an unfinished one is resumed", subtype="DIR_PATH"
    )
    shard: bpy.props.IntProperty(name="Shard", description="Part of the people that this machine renders", min=0)
    shards: bpy.props.IntProperty(
        name="Shards", description="Number of parts the people are divided into", min=1, default=1
    )

    poses: bpy.props.StringProperty(
        name="Poses",
        description="A file or folder of AMASS or pose .npz, .npy, .json, .pkl or .bvh; empty: built-in poses",
        subtype="FILE_PATH",
    )
    pose_count: declared(CaptureSettings, "pose_count", name="Count")

    arrangement: bpy.props.EnumProperty(
        name="Arrangement",
        description="Where the cameras stand",
        items=[
            ("rings", "Rings", "Rings at several heights"),
            ("sphere", "Sphere", "Evenly on all sides (Fibonacci)"),
            ("hemisphere", "Hemisphere", "Evenly from above and the sides"),
            ("custom", "Cameras of the Scene", "The cameras of a collection, fixed for all people"),
        ],
    )
    camera_count: declared(Rig, "count", name="Cameras")
    rings: bpy.props.IntProperty(
        name="Rings", description="Number of rings the cameras are distributed over", default=3, min=1, max=50
    )
    lowest: _angle("Lowest", "Angle above the horizon", -10, (-89, 89))
    highest: _angle("Highest", "Angle above the horizon", 40, (-89, 89))
    fov: _angle("Field of View", "Vertical", 30, (1, 150))
    margin: declared(Rig, "margin")
    cameras: bpy.props.PointerProperty(
        name="Collection", description="Collection with the cameras", type=bpy.types.Collection
    )

    hdri: declared(CaptureSettings, "hdri", name="HDRI")
    shadows: declared(CaptureSettings, "shadows", name="Shadows Between People")

    width: declared(Rig, "width", subtype="PIXEL")
    height: declared(Rig, "height", subtype="PIXEL")
    passes: bpy.props.EnumProperty(
        name="Passes",
        description="Kinds of pictures to write",
        options={"ENUM_FLAG"},
        items=_PASS_ITEMS,
        default=set(PASSES),
    )

    def elevations(self) -> list[float]:
        """Elevations of the rings, degrees."""
        lowest, highest = math.degrees(self.lowest), math.degrees(self.highest)
        if self.rings == 1:
            return [round((lowest + highest) / 2, 4)]
        return [round(lowest + (highest - lowest) * ring / (self.rings - 1), 4) for ring in range(self.rings)]

    def rig(self) -> Rig:
        """The rig asked for. Raises ValueError where it is the scene's cameras, or impossible."""
        if self.arrangement == "custom":
            raise ValueError("the scene's own cameras need no preview: choose another arrangement")
        return Rig(
            arrangement=self.arrangement,
            count=self.camera_count,
            elevations=tuple(self.elevations()),
            vertical_fov=math.degrees(self.fov),
            width=self.width,
            height=self.height,
            margin=self.margin,
        )


def command_args(asked: PRIMDIFFUSION_PG_captures, context: bpy.types.Context, folder: Path) -> list[str]:
    """The arguments of the command `capture` (`capture.command`); a file of cameras, where needed, goes to `folder`.

    Raises ValueError where something is missing or a path is impossible.
    """
    people, out = setting_path(asked.people, "People"), setting_path(asked.out, "Captures")
    if not people or not out:
        raise ValueError(f"choose a folder {'of people' if not people else 'for the captures'} first")
    args = ["--people", people, "--out", out, "--shard", f"{min(asked.shard, asked.shards - 1)}/{asked.shards}"]
    args += ["--poses", str(asked.pose_count), "--size", str(asked.width), str(asked.height)]
    for name in ("seed", "samples", "light", "device", "background", "together"):
        args += [f"--{name}", str(getattr(asked, name))]
    hdri = asked.hdri if asked.light == "hdri" else ""
    for name, label, path in (
        ("body", "Body", asked.body),
        ("pose-files", "Poses", asked.poses),
        ("hdri", "HDRI", hdri),
    ):
        args += [f"--{name}", setting_path(path, label)] if path else []
    shadows = asked.shadows and asked.together > 1 and asked.light != "uniform"
    args += ["--shadows"] if shadows else []
    args += [f"--{name.replace('_', '-')}" for name in _FLAGS if getattr(asked, name)]
    args += ["--passes", *(kind for kind in PASSES if kind in asked.passes)]
    return args + (_camera_args(asked, context, folder) if asked.arrangement == "custom" else _rig_args(asked.rig()))


def _rig_args(rig: Rig) -> list[str]:
    angles = [f"{angle:g}" for angle in rig.elevations]
    args = ["--arrangement", rig.arrangement, "--cameras", str(rig.count), "--elevations", *angles]
    return [*args, "--fov", f"{rig.vertical_fov:.6g}", "--margin", f"{rig.margin:.6g}"]


def _camera_args(asked: PRIMDIFFUSION_PG_captures, context: bpy.types.Context, folder: Path) -> list[str]:
    depsgraph, render = context.evaluated_depsgraph_get(), context.scene.render
    aspect = (render.pixel_aspect_x, render.pixel_aspect_y)
    objects = asked.cameras.all_objects if asked.cameras is not None else context.selected_objects
    cameras = sorted((obj for obj in objects if obj.type == "CAMERA"), key=lambda obj: obj.name)
    if not cameras:
        raise ValueError("no camera takes pictures: choose a collection with cameras, or select some")
    views = [view_of(camera, depsgraph, (asked.width, asked.height), aspect) for camera in cameras]
    named = {
        f"camera{i:04d}": {"K": v.intrinsics.tolist(), "R": v.rotation.tolist(), "T": v.translation.tolist()}
        for i, v in enumerate(views)
    }
    path = folder / "cameras.json"
    path.write_text(json.dumps(named), encoding="utf-8")
    return ["--camera-file", str(path)]


PROPERTIES = ((bpy.types.Scene, "primdiffusion_captures", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_captures)),)
