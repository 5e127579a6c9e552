"""Render humans: `render` and `draw`."""

from __future__ import annotations

import time
from pathlib import Path

import torch

from primdiffusion.body.pose_file import pose_from_numbers, read_pose
from primdiffusion.commands.frame_drawer import FrameDrawer
from primdiffusion.commands.output import decoded, march_encoded
from primdiffusion.commands.progress import ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.drawing.draw import Scene, ViewSettings
from primdiffusion.drawing.draw import draw as draw_scene
from primdiffusion.files.whole_files import written_whole
from primdiffusion.formats.answers import DrawAnswer, RenderAnswer
from primdiffusion.formats.requests import DrawRequest, RenderRequest
from primdiffusion.human import body_of, framing, place
from primdiffusion.human_file import load_human
from primdiffusion.render.image import rgba_to_png
from primdiffusion.render.march import MarchSettings

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}


def render(request: RenderRequest, session: Session, report: ReportProgress) -> RenderAnswer:
    """Render, and return the path. Raises as load_human and read_pose, and OSError."""
    began = time.perf_counter()
    report("load", 0, 1, None)
    human, pose, given = load_human(request.human), None, request.pose
    if isinstance(given, Path):
        pose = read_pose(given, request.frame, request.tracked_person)
    elif given is not None:
        pose = pose_from_numbers(given, "the parameter pose")
    primitives = place(human, pose)
    width, height = (request.size if side is None else side for side in (request.width, request.height))
    camera, background = framing(primitives, request.yaw_degrees, width, height), BACKGROUNDS[request.background]
    report("render", 0, 1, None)
    if request.compositing == "released":
        rgba = decoded(march_encoded(primitives, camera), background)
    else:
        scene = Scene(primitives, chart=body_of(human)[1].chart)
        look = ViewSettings(request.view, settings=MarchSettings(step=request.step))
        rgba = torch.from_numpy(draw_scene(scene, camera, look).rgba)
    report("write", 1, 1, 0.0)
    with written_whole(request.out) as file:
        rgba_to_png(file, rgba, background)
    return RenderAnswer(out=request.out, seconds=round(time.perf_counter() - began, 3))


def draw(request: DrawRequest, session: Session, report: ReportProgress) -> DrawAnswer:
    """See `FrameDrawer.draw`."""
    return session.cached(FrameDrawer).draw(request, report)
