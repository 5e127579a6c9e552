"""Render humans: `render` and `draw`. The render engine draws many frames, so `FrameDrawer` caches for the next one."""

from __future__ import annotations

import functools
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from primdiffusion.body.model import BodyModel, default_body, read_pose
from primdiffusion.commands.output import render_srgb, to_linear_rgba
from primdiffusion.commands.progress import ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.drawing import BAND_SECONDS, FIRST_PIXELS, Scene, ViewSettings, draw_in_bands
from primdiffusion.drawing import draw as draw_scene
from primdiffusion.editing.reshaping import reshape_human
from primdiffusion.files.arrays import read_numbers
from primdiffusion.files.regular_files import as_file_error
from primdiffusion.files.whole_files import atomic_path
from primdiffusion.formats.answers import DrawAnswer, RenderAnswer
from primdiffusion.formats.requests import DrawRequest, RenderRequest
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import Image
from primdiffusion.human import Human, body_of, framing, place, place_skinned
from primdiffusion.human_file import load_human
from primdiffusion.primitives.anchors import Anchors, default_anchors
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render import cuda
from primdiffusion.render.image import rgba_to_png
from primdiffusion.render.march import MarchSettings
from primdiffusion.render.solids import Solids
from primdiffusion.runtime.failures import PictureOutOfMemory, out_of_memory

CHANNELS = 5
"""Channels of a frame: RGBA and depth."""
HUMANS_CACHED = 64
"""About 8 MB each, and a quarter of that again where they are scaled."""
SOLIDS_CACHED = 2
MOST_DOUBLINGS = 16
"""Largest range of scales in a frame, in powers of two."""

Stamp = tuple[Path, int, int]
"""Path, modification time and size of a file."""
Numbers = tuple[Any, ...]
"""Nested tuples of floats."""


class FrameDrawer:
    """Draws frames, and caches the humans, placed primitives and solids of the last ones."""

    def __init__(self, device: torch.device) -> None:
        """Draw on `device` if it has a fast marcher, otherwise on the CPU."""
        self._device = device if cuda.available(device) else torch.device("cpu")
        self._human = functools.lru_cache(HUMANS_CACHED)(self._load)
        self._shaped = functools.lru_cache(HUMANS_CACHED)(self._reshape)
        self._rig = functools.lru_cache(1)(self._body)
        self._placed = functools.lru_cache(HUMANS_CACHED)(self._place)
        self._all_placed = functools.lru_cache(2)(self._together)
        self._solids = functools.lru_cache(SOLIDS_CACHED)(_load_solids)
        self._speed: dict[tuple[str, float, int], float] = {}
        """Pixels per second of the last frame, by view, step and number of humans."""

    def draw(self, frame: DrawRequest, report: ReportProgress) -> DrawAnswer:
        """Fill the frame band by band from the top, with a report after each; return the time taken.

        Raises as load_human and place_skinned, ValueError for a frame of the wrong size or an invalid file of solids,
        OSError, and PictureOutOfMemory.
        """
        began = time.perf_counter()
        width, height = frame.size
        picture = map_frame(frame.frame, width, height)
        report("draw", 0, height, None)
        people = tuple((_stamp(p.human), _frozen(p.object), _frozen(p.joints), _frozen(p.betas)) for p in frame.people)
        try:
            scene = self._scene(people, frame)
            placed = time.perf_counter()
            seconds = self._fill(picture, scene, frame, report)
        except Exception as e:
            if out_of_memory(e):
                raise PictureOutOfMemory(width, height) from e
            raise
        return DrawAnswer(
            seconds=round(time.perf_counter() - began, 6),
            seconds_place=round(placed - began, 6),
            seconds_march=round(seconds, 6),
        )

    def _scene(self, people: tuple[Numbers, ...], frame: DrawRequest) -> Scene:
        solids = None if frame.solids is None else self._solids(_stamp(frame.solids))
        if not people:
            return Scene(None, solids)
        chart = (
            torch.cat([self._body_and_anchors(person[0])[1].chart for person in people])
            if frame.view == "boxes"
            else None
        )
        return Scene(self._all_placed(people), solids, None if chart is None else chart.cpu())

    def _together(self, people: tuple[Numbers, ...]) -> Primitives:
        placed = [self._placed(*person) for person in people]
        return placed[0] if len(placed) == 1 else Primitives.together(placed)

    def _place(self, file: Stamp, matrix: Numbers, joints: Numbers, betas: Numbers | None) -> Primitives:
        human = self._human(file) if betas is None else self._shaped(file, betas)
        return place_skinned(human, self._tensor(joints), self._tensor(matrix), *self._body_and_anchors(file))

    def _reshape(self, file: Stamp, betas: Numbers) -> Human:
        return reshape_human(self._human(file), self._tensor(betas), *self._body_and_anchors(file))

    def _tensor(self, numbers: Numbers) -> torch.Tensor:
        return torch.tensor(numbers, dtype=torch.float32, device=self._device)

    def _body(self) -> tuple[BodyModel, Anchors]:
        return default_body().to(self._device), default_anchors().to(self._device)

    def _body_and_anchors(self, file: Stamp) -> tuple[BodyModel, Anchors]:
        body_setup = self._human(file).body_setup
        return self._rig() if body_setup is None else (body_setup.body, body_setup.anchors)

    def _load(self, file: Stamp) -> Human:
        return load_human(file[0]).to(self._device)

    def _fill(self, picture: Image, scene: Scene, frame: DrawRequest, report: ReportProgress) -> float:
        """Draw the scene; return the seconds spent in the marcher."""
        look = ViewSettings(
            frame.view,
            None if frame.background is None else tuple(frame.background),
            (frame.clip[0], frame.clip[1]),
            settings_for(frame.step, [person.object for person in frame.people]),
        )
        began, seconds, height = time.perf_counter(), 0.0, len(picture.depth)
        kind = (frame.view, frame.step, len(frame.people))
        speed = self._speed.get(kind) or _first_guess(frame)
        for done in draw_in_bands(picture, scene, self._camera(frame), look, speed):
            self._speed[kind], seconds = done.pixels_a_second, done.seconds_march
            left = (time.perf_counter() - began) / done.rows * (height - done.rows)
            report("draw", done.rows, height, round(left, 3))
        return seconds

    def _camera(self, frame: DrawRequest) -> Camera:
        intrinsics, view = (torch.tensor(m, dtype=torch.float32) for m in (frame.intrinsics, frame.world_to_camera))
        whole = Camera(intrinsics.float(), view.float(), frame.width, frame.height).to(self._device)
        return whole if frame.region is None else whole.crop(*frame.corner, *frame.size)


def map_frame(path: Path, width: int, height: int) -> Image:
    """Map a frame file as an image; writing to it writes to the file.

    Raises FileNotFoundError, ValueError for a file of another size, OSError.
    """
    wanted = width * height * CHANNELS * 4
    given = _stamp(path)[2]
    if given != wanted:
        raise ValueError(
            f"the frame {path} has {given} bytes, but {width} x {height} pixels need {wanted} (5 float32 a pixel): "
            "create it for this size"
        )
    values = np.asarray(np.memmap(path, np.float32, "r+", shape=(width * height * CHANNELS,)))
    combined, depth = values[: width * height * 4], values[width * height * 4 :]
    rgba = combined.reshape(height, width, 4)[::-1]
    return Image(rgba[..., :3], rgba[..., 3], depth.reshape(height, width)[::-1])


def _first_guess(frame: DrawRequest) -> float:
    """A cautious estimate of pixels per second, from the number of samples and humans."""
    plain = FIRST_PIXELS / BAND_SECONDS
    return plain * min(1.0, frame.step / MarchSettings().step) / max(1, len(frame.people))


def settings_for(step: float, objects: list[Any]) -> MarchSettings:
    """Adapt the marcher to the scales of the objects, whose world matrices [3][4] are `objects`.

    The lattice shrinks with the smallest human, or small boxes would fall between its points; strides grow with the
    largest, so that it costs no more than one of natural size. By powers of two: within a factor of 1.4 of natural size
    nothing changes.
    """
    volumes = [abs(float(np.linalg.det(np.array(matrix)[:, :3]))) for matrix in objects]
    powers = [round(math.log2(volume) / 3) for volume in volumes if volume > 0] or [0]
    plain = MarchSettings()
    coarser = [2**i * plain.strides[0] for i in range(min(max(powers) - min(powers), MOST_DOUBLINGS), 0, -1)]
    return MarchSettings(step=step * 2.0 ** max(powers), strides=(*coarser, *plain.strides))


def _stamp(path: Path) -> Stamp:
    try:
        found = os.stat(path)
    except (FileNotFoundError, ValueError):  # ValueError: a path with a null character
        raise FileNotFoundError(f"there is no file {path}: check the path") from None
    return path, found.st_mtime_ns, found.st_size


def _frozen(value: Any) -> Any:
    """Convert nested lists of numbers to nested tuples of floats, for use as keys."""
    if value is None:
        return None
    return tuple(map(_frozen, value)) if isinstance(value, list) else float(value)


def _load_solids(file: Stamp) -> Solids:
    """Raise ValueError, naming the file, for an invalid file."""
    path = file[0]
    with as_file_error(path, "holds no solids", "it needs corners [F, 3, 3], colour [F, 3], holdout [F]"):
        arrays = read_numbers(path, ("corners", "colour", "holdout"))
        return Solids(
            np.ascontiguousarray(arrays["corners"], np.float32),
            np.ascontiguousarray(arrays["colour"], np.float32),
            np.ascontiguousarray(arrays["holdout"], np.bool_),
        )


BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}


def render(request: RenderRequest, session: Session, report: ReportProgress) -> RenderAnswer:
    """Render, and return the path. Raises as load_human and read_pose, and OSError."""
    began = time.perf_counter()
    report("load", 0, 1, None)
    human = load_human(request.human)
    pose = None if request.pose is None else read_pose(request.pose, request.frame, request.tracked_person)
    primitives = place(human, pose)
    width, height = (request.size if side is None else side for side in (request.width, request.height))
    camera, background = framing(primitives, request.yaw_degrees, width, height), BACKGROUNDS[request.background]
    report("render", 0, 1, None)
    if request.compositing == "released":
        rgba = to_linear_rgba(render_srgb(primitives, camera), background)
    else:
        scene = Scene(primitives, chart=body_of(human)[1].chart)
        look = ViewSettings(request.view, settings=MarchSettings(step=request.step))
        rgba = torch.from_numpy(draw_scene(scene, camera, look).rgba)
    report("write", 1, 1, 0.0)
    with atomic_path(request.out) as file:
        rgba_to_png(file, rgba, background)
    return RenderAnswer(out=request.out, seconds=round(time.perf_counter() - began, 3))


def draw(request: DrawRequest, session: Session, report: ReportProgress) -> DrawAnswer:
    """See `FrameDrawer.draw`."""
    return session.cached(FrameDrawer).draw(request, report)
