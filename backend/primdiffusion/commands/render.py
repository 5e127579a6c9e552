"""Render humans: `primdiffusion render`, and `render` and `draw` of JSON-RPC."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from primdiffusion.commands.frame import FrameSpec
from primdiffusion.commands.request import ReportProgress, check_angle, check_ending, check_sides, parse
from primdiffusion.formats.regular_files import real_path
from primdiffusion.formats.requests import PICTURE_SIZE, RAY_STEP, VIEWS, View, check_step
from primdiffusion.formats.whole_files import written_whole

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RenderRequest:
    """Render a saved human on black."""

    human: Path
    """A .human.safetensors file."""
    out: Path
    """Output PNG."""
    width: int = PICTURE_SIZE
    height: int = PICTURE_SIZE
    yaw: float = 0.0
    """Camera position around the human, radians: 0 in front, pi/2 at the human's left."""
    pose: Path | list | None = None
    """72 axis-angle values (24 x 3, radians), or a pose file (.json, .npz); None for the T pose."""
    depth: Path | None = None
    """A second PNG, of the depth."""

    def check(self) -> None:
        """See `RequestRecord`."""
        for path in (self.out, self.depth):
            check_ending(path, ".png")
        check_sides(self.width, self.height)
        check_angle("yaw", self.yaw, "radians")

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Render, and return the paths. Raises as load_human and read_pose, and OSError."""
        # torch is loaded late
        from primdiffusion.human import framing, place
        from primdiffusion.human_file import load_human
        from primdiffusion.pose_file import pose_from_numbers, read_pose
        from primdiffusion.render.image import depth_to_png, to_png
        from primdiffusion.render.march import march

        began = time.perf_counter()
        report("load", 0, 1, None)
        human = load_human(self.human)
        pose = None
        if self.pose is not None:
            given = self.pose
            pose = read_pose(given) if isinstance(given, Path) else pose_from_numbers(given, "the parameter pose")
        primitives = place(human, pose)
        report("render", 0, 1, None)
        rendering = march(primitives, framing(primitives, self.yaw, self.width, self.height))
        report("write", 1, 1, 0.0)
        with contextlib.ExitStack() as files:  # both files or none
            to_png(files.enter_context(written_whole(self.out)), rendering)
            if self.depth is not None:
                depth_to_png(files.enter_context(written_whole(self.depth)), rendering)
        depth = None if self.depth is None else str(self.depth)
        return {"out": str(self.out), "depth": depth, "seconds": round(time.perf_counter() - began, 3)}


@dataclasses.dataclass(frozen=True)
class DrawRequest(FrameSpec):
    """Draw posed humans into a mapped file, for the render engine and viewport. Needs no checkpoint."""

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """See `FrameDrawer.draw`."""
        from primdiffusion.commands.frame_drawer import FrameDrawer  # torch is loaded late

        return session.cached(FrameDrawer).draw(self, report)


@dataclasses.dataclass(frozen=True)
class RenderCommand:
    """Render a human in a pose."""

    human: tyro.conf.Positional[Path]
    """A .human.safetensors file."""
    out: Path
    """Output PNG."""
    yaw: float = 0.0
    """Camera position around the human, degrees: 0 in front, 90 at the human's left."""
    pose: Path | None = None
    """.json or .npz with 72 axis-angle numbers (24 joints x 3, radians); the default is the T pose."""
    frame: int = 0
    """Frame of a pose file with several."""
    size: int = PICTURE_SIZE
    """Width and height, pixels."""
    width: int | None = None
    """Pixels; the default is --size."""
    height: int | None = None
    """Pixels; the default is --size."""
    view: View = VIEWS[0]
    """colour; depth in false colours, bright where near; alpha in grey; boxes: the primitives."""
    step: float = RAY_STEP
    """Metres between samples of a ray; finer is slower and more accurate."""
    background: Literal["black", "white", "transparent"] = "black"
    """Background behind the human."""
    depth: Path | None = None
    """A second PNG: depth in false colours, bright where near."""

    def draw(self) -> None:
        """Render, and print the path."""
        import torch  # late

        # torch is loaded late
        from primdiffusion.drawing.draw import draw
        from primdiffusion.drawing.scene import Scene, ViewSettings
        from primdiffusion.human import body_of, framing, place
        from primdiffusion.human_file import load_human
        from primdiffusion.pose_file import read_pose
        from primdiffusion.render.image import depth_to_png, rgba_to_png
        from primdiffusion.render.march import MarchSettings, march

        look = ViewSettings(self.view, settings=MarchSettings(step=self.step))
        human = load_human(self.human)
        primitives = place(human, None if self.pose is None else read_pose(self.pose, self.frame))
        width, height = (self.size if side is None else side for side in (self.width, self.height))
        camera = framing(primitives, math.radians(self.yaw), width, height)
        picture = draw(Scene(primitives, chart=body_of(human)[1].chart), camera, look)
        with contextlib.ExitStack() as files:  # both files or none
            rgba_to_png(
                files.enter_context(written_whole(self.out)),
                torch.from_numpy(picture.combined),
                BACKGROUNDS[self.background],
            )
            if self.depth is not None:
                rendering = march(primitives, camera, look.settings)
                depth_to_png(files.enter_context(written_whole(self.depth)), rendering)
        print(self.out)

    def check(self) -> None:
        """See `RequestRecord`."""
        for path in (self.out, self.depth):
            check_ending(path, ".png")
        check_angle("yaw", self.yaw, "degrees")
        check_step(self.step)
        if self.depth is not None and real_path(self.depth) == real_path(self.out):
            raise ValueError(f"out and depth are both {self.out}: give two different files")
        if self.frame and self.pose is None:
            raise ValueError(f"frame {self.frame} was requested without a pose file: give one with --pose")


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    parse(RenderCommand, arguments, "render").draw()
