"""What the panel Render Captures asks for, saved with the scene; and the running capture, in another Blender."""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..backend.child_process import BLENDER, COMPUTING, Output, passed_on
from ..backend.requests import Step, Steps
from ..capture.cameras import view_of
from ..capture.command import MARK
from ..capture.settings import CaptureSettings
from ..console import DONE, duration
from ..files.json_files import parse_message
from ..files.regular_files import remove_folder
from ..formats.answers import CapturesProgress
from ..formats.camera_rig import Rig
from ..formats.requests import PASSES
from ..formats.schema import read
from ..jobs.follow import Session
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


captures = Session("captures are being rendered", "Cancelled; the same settings resume from here")
"""One for all windows."""


def capturing(words: Sequence[str], folder: Path) -> Steps:
    """Steps of the command `capture`, whose temporary files go to `folder`, which is removed.

    Closing it kills the Blender that renders: its views are written whole or not at all.
    """
    output, errors, process = Output(), Output(), None
    step, said = Step("Starting Blender", 0.0), []
    try:
        process = subprocess.Popen(
            [*child_command(), *words, "--progress", "json", "--while-stdin"],
            stdin=subprocess.PIPE,
            stdout=output.target,
            stderr=errors.target,
            env={**passed_on(COMPUTING, BLENDER), "TMPDIR": str(folder), "TEMP": str(folder), "TMP": str(folder)},
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
        exit_code = None
        while exit_code is None or not output.at_end:
            exit_code = process.poll()  # before reading: then all that it wrote is there
            for line in output.lines():
                if line.startswith(MARK.encode()):  # others are Blender's
                    step = _step(line.decode("utf-8", "replace")[len(MARK) :], step)
                    said = [*said, *step.lines][-2:]
                    yield step
            yield Step(step.message, step.fraction)
        if exit_code == DONE:
            return said[-1]
        complaints = [line.removeprefix("capture: ") for line in errors.log() if line.startswith("capture: ")]
        raise RuntimeError("; ".join(complaints[-1:] or said) or f"Blender ended with code {exit_code}")
    finally:
        if process is not None:
            process.kill()
            process.wait()
            with contextlib.suppress(OSError):
                process.stdin.close()
        output.close()
        errors.close()
        remove_folder(folder, folder.parent)


def _step(message: str, before: Step) -> Step:
    """What a message of the child says. Raises RuntimeError for a malformed one."""
    try:
        progress = read(CapturesProgress, parse_message(message))
    except ValueError as fault:
        raise RuntimeError(f"Blender was ended because it sent a malformed message ({fault}): render again") from fault
    if progress.line is not None:
        return Step(before.message, before.fraction, (progress.line,))
    left = f" ({duration(progress.eta_s)} left)" if progress.eta_s else ""
    text = f"{progress.subject}: view {progress.done} of {progress.total}{left}"
    return Step(text, progress.done / max(progress.total, 1), tuple(progress.news))


def child_command() -> list[str]:
    """The command that starts a Blender for captures, without its options."""
    script = str(Path(__file__).resolve().parents[1] / "capture" / "__main__.py")
    if bpy.app.binary_path:
        return [bpy.app.binary_path, "-b", "--factory-startup", "--python", script, "--"]
    return [sys.executable, script, "--"]
