"""Render humans: `render` and `draw`."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

import torch

from primdiffusion.commands.frame_drawer import FrameDrawer
from primdiffusion.commands.options import RenderCommand
from primdiffusion.commands.output import decoded, march_encoded
from primdiffusion.commands.progress import ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.drawing.draw import draw as draw_scene
from primdiffusion.drawing.scene import Scene, ViewSettings
from primdiffusion.formats.answers import DrawAnswer, RenderAnswer
from primdiffusion.formats.requests import DrawRequest, RenderRequest
from primdiffusion.formats.whole_files import written_whole
from primdiffusion.human import body_of, framing, place
from primdiffusion.human_file import load_human
from primdiffusion.pose_file import pose_from_numbers, read_pose
from primdiffusion.render.image import depth_to_png, rgba_to_png
from primdiffusion.render.march import RELEASED, MarchSettings, march

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}


def render(request: RenderRequest | RenderCommand, session: Session, report: ReportProgress) -> RenderAnswer | Path:
    """Render, and return the paths. Raises as load_human and read_pose, and OSError."""
    if isinstance(request, RenderCommand):
        return _render_view(request)
    began = time.perf_counter()
    report("load", 0, 1, None)
    human = load_human(request.human)
    pose = None
    if request.pose is not None:
        given = request.pose
        pose = read_pose(given) if isinstance(given, Path) else pose_from_numbers(given, "the parameter pose")
    primitives = place(human, pose)
    report("render", 0, 1, None)
    rendering = march(primitives, framing(primitives, request.yaw_degrees, request.width, request.height))
    report("write", 1, 1, 0.0)
    with contextlib.ExitStack() as files:  # both files or none
        rendering.save(files.enter_context(written_whole(request.out)), BACKGROUNDS["black"])
        if request.depth is not None:
            depth_to_png(files.enter_context(written_whole(request.depth)), rendering.depth, rendering.alpha)
    return RenderAnswer(out=request.out, depth=request.depth, seconds=round(time.perf_counter() - began, 3))


def draw(request: DrawRequest, session: Session, report: ReportProgress) -> DrawAnswer:
    """See `FrameDrawer.draw`."""
    return session.cached(FrameDrawer).draw(request, report)


def _render_view(command: RenderCommand) -> Path:
    look = ViewSettings(command.view, settings=MarchSettings(step=command.step))
    human = load_human(command.human)
    primitives = place(
        human, None if command.pose is None else read_pose(command.pose, command.frame, command.tracked_person)
    )
    width, height = (command.size if side is None else side for side in (command.width, command.height))
    camera = framing(primitives, command.yaw, width, height)
    background = BACKGROUNDS[command.background]
    if command.compositing == "released":
        look = ViewSettings(settings=RELEASED)
        rgba = decoded(march_encoded(primitives, camera), background)
    else:
        picture = draw_scene(Scene(primitives, chart=body_of(human)[1].chart), camera, look)
        rgba = torch.from_numpy(picture.combined)
    with contextlib.ExitStack() as files:  # both files or none
        rgba_to_png(files.enter_context(written_whole(command.out)), rgba, background)
        if command.depth is not None:
            rendering = march(primitives, camera, look.settings)
            depth_to_png(files.enter_context(written_whole(command.depth)), rendering.depth, rendering.alpha)
    return command.out
