"""The panel Captures: what it asks for, saved with the scene; the capture that runs in another Blender; and the
extension's command line, `blender -c primdiffusion capture ...`."""

from __future__ import annotations

import contextlib
import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..backend.child_process import BLENDER, COMPUTING, Output, passed_on
from ..backend.requests import Step, Steps
from ..capture.cameras import view_of
from ..capture.command import MARK, main, parse, settings_of
from ..capture.settings import CaptureSettings
from ..console import DONE, UNUSABLE, duration
from ..files.json_files import parse_message
from ..files.regular_files import remove_folder
from ..formats.answers import CapturesProgress
from ..formats.camera_rig import Rig
from ..formats.requests import PASSES
from ..formats.schema import read
from ..jobs.follow import Reporting, StepRunner
from ..places import shows_captures
from ..scene.blend_values import setting_path
from .declared import declared
from .drawing import SidebarPanel, draw_lines, property_columns

_PASS_NAMES = {
    "img": ("Colour", "What the camera sees, over black"),
    "mask": ("Mask", "Coverage of each pixel by the person"),
    "depth": ("Depth", "Metres along the optical axis, 16 bits"),
    "normal": ("Normal", "Surface normal in world space"),
    "part": ("Part", "Which of the 24 joints moves the surface"),
}
_PASS_ITEMS = [(kind, *_PASS_NAMES[kind], 1 << i) for i, kind in enumerate(PASSES)]


class PRIMDIFFUSION_PG_captures(bpy.types.PropertyGroup):
    """`scene.primdiffusion_captures`."""

    __slots__ = ()
    people: bpy.props.StringProperty(
        name="People", description="Folder of scans or of exported humans (.glb, .fbx, .obj)", subtype="DIR_PATH"
    )
    out: bpy.props.StringProperty(
        name="Captures", description="Folder of the dataset; an unfinished one is resumed", subtype="DIR_PATH"
    )
    body: declared(CaptureSettings, "body")
    seed: declared(CaptureSettings, "seed")
    poses: bpy.props.StringProperty(
        name="Poses",
        description="A file or folder of AMASS or pose .npz, .npy, .json, .pkl or .bvh; empty: built-in poses",
        subtype="FILE_PATH",
    )
    pose_count: declared(CaptureSettings, "pose_count", name="Pose Count")
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
    cameras: bpy.props.PointerProperty(
        name="Collection",
        description="Collection with the cameras; without one, the selected cameras",
        type=bpy.types.Collection,
    )
    width: declared(Rig, "width", subtype="PIXEL")
    height: declared(Rig, "height", subtype="PIXEL")
    passes: bpy.props.EnumProperty(
        name="Passes",
        description="Kinds of pictures to write",
        options={"ENUM_FLAG"},
        items=_PASS_ITEMS,
        default=set(PASSES),
    )
    samples: declared(CaptureSettings, "samples")
    light: declared(CaptureSettings, "light")
    hdri: declared(CaptureSettings, "hdri", name="HDRI")
    options: bpy.props.StringProperty(
        name="More Options", description="Further options as on the command line, such as --together 4 --fov 20"
    )


def command_args(asked: PRIMDIFFUSION_PG_captures, context: bpy.types.Context, folder: Path) -> list[str]:
    """The arguments of the command `capture` (`capture.command`); a file of cameras, where needed, goes to `folder`.

    Raises ValueError where something is missing or a path is impossible.
    """
    people, out = setting_path(asked.people, "People"), setting_path(asked.out, "Captures")
    if not people or not out:
        raise ValueError(f"choose a folder {'of people' if not people else 'for the captures'} first")
    args = ["--people", people, "--out", out, "--poses", str(asked.pose_count)]
    args += ["--size", str(asked.width), str(asked.height)]
    for name in ("seed", "samples", "light"):
        args += [f"--{name}", str(getattr(asked, name))]
    hdri = asked.hdri if asked.light == "hdri" else ""
    for name, label, path in (
        ("body", "Body", asked.body),
        ("pose-files", "Poses", asked.poses),
        ("hdri", "HDRI", hdri),
    ):
        args += [f"--{name}", setting_path(path, label)] if path else []
    args += ["--passes", *(kind for kind in PASSES if kind in asked.passes)]
    if asked.arrangement == "custom":
        args += _camera_args(asked, context, folder)
    else:
        args += ["--arrangement", asked.arrangement, "--cameras", str(asked.camera_count)]
    return args + shlex.split(asked.options)


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


captures = StepRunner("captures are being rendered", "Cancelled; the same settings resume from here")
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


class PRIMDIFFUSION_OT_render_captures(Reporting, bpy.types.Operator):
    """Render all people in the folder from all sides, into the folder of captures"""

    bl_idname = "primdiffusion.render_captures"
    bl_label = "Render Captures"

    def act(self, context: bpy.types.Context) -> set[str]:
        """Another Blender renders; a timer follows it, or in background mode this waits."""
        folder = Path(tempfile.mkdtemp(prefix="primdiffusion_captures_", dir=bpy.app.tempdir or None))
        args = command_args(context.scene.primdiffusion_captures, context, folder)
        settings_of(parse(args))  # report impossible settings at once
        captures.start(capturing(args, folder))
        return captures.follow(self)


_SHOWN_LINES = 4


class PRIMDIFFUSION_PT_captures(SidebarPanel, bpy.types.Panel):
    """From where to where, the button, how far it is, and all settings; shown if the preferences ask for it."""

    bl_label = "Captures"
    bl_order = 10
    bl_options = {"DEFAULT_CLOSED"}
    manual_page = "captures"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return shows_captures()

    def draw(self, context: bpy.types.Context) -> None:
        layout, asked = property_columns(self.layout), context.scene.primdiffusion_captures
        if captures.busy:
            layout.progress(factor=captures.fraction, text=captures.message, translate=False)
            layout.operator("primdiffusion.cancel", icon="CANCEL").what = "CAPTURES"
        else:
            layout.operator("primdiffusion.render_captures", icon="RENDER_ANIMATION")
        for text, icon in ((captures.error, "ERROR"), (captures.notice, "INFO")):
            draw_lines(layout, text, icon)
        if captures.busy or captures.error:
            for text in list(captures.lines)[-_SHOWN_LINES:]:
                draw_lines(layout, text, "DOT")
        column = layout.column()
        column.enabled = not captures.busy  # they would have no effect
        for name in (
            "people", "out", "body", "seed", "poses", "pose_count", "arrangement",
            "cameras" if asked.arrangement == "custom" else "camera_count", "width", "height", "passes", "samples",
            "light", *(["hdri"] if asked.light == "hdri" else []), "options",
        ):  # fmt: skip
            column.column().prop(asked, name)  # flags are one below the other


COMMAND = "primdiffusion"
_HELP = """\
blender -c primdiffusion capture --people SCANS --out CAPTURES         captures from all sides, to train on
It has more options: see capture --help. Humans: primdiffusion generate, or examples/blender_batch.py."""
_handles: list[object] = []
"""Handles of the registered command."""


def execute(argv: Sequence[str]) -> int:
    """Run a command; returns its exit code."""
    if argv and argv[0] == "capture":
        return main(list(argv[1:]))
    asked = list(argv) in (["--help"], ["-h"])
    print(_HELP, file=sys.stdout if asked else sys.stderr, flush=True)
    return DONE if asked else UNUSABLE


def register() -> None:
    """Register the command with Blender."""
    _handles.append(bpy.utils.register_cli_command(COMMAND, execute))


def unregister() -> None:
    """End the running capture, and the command."""
    captures.close()
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
