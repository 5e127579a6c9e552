"""The files of a human in an output folder, and previews while it is sampled.

Requests that show previews while sampling do not wait for the marcher's compiler (half a minute, once on a machine): it
runs in a process of its own at low priority, and their humans come without previews until it has ended.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyPose
from primdiffusion.diffusion.model import BETAS
from primdiffusion.diffusion.samplers import SamplerStep
from primdiffusion.files.regular_files import remove_file
from primdiffusion.formats.answers import VariationFiles
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.requests import Compositing
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.human import Human, framing, place
from primdiffusion.human_file import save_body, save_human
from primdiffusion.primitives.primitives import K, Payload, Primitives, S
from primdiffusion.render.cpu.compiled import is_compiled
from primdiffusion.render.cpu.forward import march_tiles
from primdiffusion.render.image import Background, depth_to_png, rgba_to_png
from primdiffusion.render.march import RELEASED, Rendering, march
from primdiffusion.runtime.worker_process import end_with_parent

INTERVAL_S = 0.4
"""Seconds between two previews."""
TIME_SHARE = 0.25
"""Largest fraction of the time spent on previews."""
PREVIEWS = 2
"""Files at a time: one may still be being read when the next one appears."""
THREE_QUARTERS = 20
"""Degrees."""
ARMS_DOWN = math.radians(62)
BLACK = (0.0, 0.0, 0.0)

Decode = Callable[[Tensor], Human | None]
"""Decodes an x0 guess [b, ...] of a sampler to a human; None if there is nothing to show yet."""


@dataclasses.dataclass(frozen=True)
class OutputFiles:
    """File names in an output folder."""

    human: str = "person.human.safetensors"
    body: str = "body.safetensors"
    """Only for a human on a body of the user's files."""
    front: str = "front.png"
    side: str = "side.png"
    depth: str = "depth.png"

    def in_folder(self, folder: Path, *, previews: bool = True) -> dict[str, Any]:
        """Return the paths by their names in answers."""
        pictures = {"preview": self.front, "side": self.side, "depth": self.depth} if previews else {}
        return {name: folder / file for name, file in {"person": self.human, **pictures}.items()}


FILES = OutputFiles()


def write_human(
    folder: Path,
    human: Human,
    size: int,
    *,
    compact: bool = False,
    compositing: Compositing = "linear",
    previews: bool = True,
) -> None:
    """Write all FILES: the human, and unless `previews` is false, previews of size x size pixels in the T pose.

    The first preview on a machine takes half a minute longer: the marcher is compiled, and cached. Raises OSError.
    """
    write_files(folder / FILES.human, human, compact=compact)
    if not previews:
        return
    primitives = place(human)
    front = draw(folder / FILES.front, primitives, framing(primitives, 0, size, size), BLACK, compositing)
    depth_to_png(folder / FILES.depth, front.depth, front.alpha)
    draw(folder / FILES.side, primitives, framing(primitives, 90, size, size), BLACK, compositing)


def write_files(path: Path, human: Human, *, compact: bool = False) -> None:
    """Write the human's file to `path`, and for a body of the user's files that body beside it. Raises OSError."""
    save_human(path, human, compact=compact)
    if human.body_setup is not None:
        save_body(path.with_name(FILES.body), human.body_setup.body, human.body_setup.anchors)


def variation_files(folder: Path, seed: int) -> VariationFiles:
    """The files of one of several humans."""
    return VariationFiles(seed=seed, person=folder / f"{seed}.human.safetensors", picture=folder / f"{seed}.png")


_compiler: list[BaseProcess] = []


def skips_previews(px: int) -> bool:
    """Whether previews of px pixels are left out because the marcher is being compiled; starts that where needed."""
    if px == 0 or is_compiled(march_tiles):
        return False
    if not _compiler:
        _compiler.append(multiprocessing.get_context("spawn").Process(target=_compile, daemon=True))
        _compiler[0].start()
    return _compiler[0].is_alive()


def _compile() -> None:
    end_with_parent()
    if hasattr(os, "nice"):  # Windows has it not
        os.nice(10)
    nothing = Payload(torch.zeros(K, 3, S, S, S), torch.zeros(K, S, S, S), torch.zeros(K, 3))
    primitives = place(Human(nothing, torch.zeros(BETAS), {}))
    march(primitives, framing(primitives, 0, 2, 2))


class PreviewBudget:
    """Limits previews to one every `interval_s` seconds and to TIME_SHARE of the time."""

    def __init__(self, interval_s: float = INTERVAL_S) -> None:
        self._interval_s = interval_s
        self._began = self._last = time.perf_counter()
        self._spent, self._cost = 0.0, 0.0
        self._drawn = 0

    def allows(self) -> bool:
        """Return whether a preview that takes as long as the last one may be drawn now."""
        now = time.perf_counter()
        affordable = self._spent + self._cost <= TIME_SHARE * (now - self._began + self._cost)
        return now - self._last >= self._interval_s and affordable

    @contextlib.contextmanager
    def measure(self) -> Iterator[None]:
        """Measure the drawing of a preview, except of the first, which loads and compiles the marcher."""
        began = time.perf_counter()
        yield
        self._last = time.perf_counter()
        if self._drawn:
            self._cost = self._last - began
            self._spent += self._cost
        self._drawn += 1


class PreviewFiles(contextlib.AbstractContextManager):
    """Temporary files in `folder`: each has a new name, the last `count` stay, and all are removed at the end."""

    def __init__(self, folder: Path, count: int) -> None:
        self._folder, self._limit = folder, count
        self._named: list[Path] = []
        self._count = 0

    def next(self) -> Path:
        """Return the next name and remove the oldest file."""
        self._count += 1
        self._named.append(self._folder / f"passing_{self._count:04d}.png")
        self._remove(self._named[: -self._limit])
        self._named = self._named[-self._limit :]
        return self._named[-1]

    def __exit__(self, *_: object) -> None:
        self._remove(self._named)

    def _remove(self, paths: list[Path]) -> None:
        for path in paths:
            with contextlib.suppress(OSError):  # Windows keeps a file that is being read; it is removed with the folder
                remove_file(path, path.parent)


@contextlib.contextmanager
def step_previews(
    folder: Path, px: int, decode: Decode, compositing: Compositing = "linear"
) -> Iterator[Callable[[SamplerStep], Path | None]]:
    """Yield a function to call after each step: it may draw a preview of px x px pixels and returns its path, or None.

    Earlier previews are removed. px = 0 draws none.
    """
    if px == 0:
        yield lambda _step: None
        return
    budget = PreviewBudget()

    def preview(step: SamplerStep) -> Path | None:
        if step.index + 1 == step.total or not budget.allows() or skips_previews(px):  # the result follows the last
            return None
        with budget.measure():
            human = decode(step.x0)
            if human is None:
                return None
            path = files.next()
            draw_front(path, human, px, compositing)
        return path

    with PreviewFiles(folder, PREVIEWS) as files:
        yield preview


def draw(
    path: Path, primitives: Primitives, camera: Camera, background: Background | None, compositing: Compositing
) -> Rendering:
    """Write a PNG over `background` (linear RGB), transparent if it is None, and return what was rendered.

    With released compositing its colours are sRGB-encoded.
    """
    if compositing == "released":
        rendering = render_srgb(primitives, camera)
        rgba_to_png(path, to_linear_rgba(rendering, background), background)
    else:
        rendering = march(primitives, camera)
        rendering.save(path, background)
    return rendering


def render_srgb(primitives: Primitives, camera: Camera) -> Rendering:
    """The rendering of the authors' code, which interpolates and composites colours in sRGB's encoding (SPEC 4)."""
    return march(dataclasses.replace(primitives, rgb=encode_srgb(primitives.rgb)), camera, RELEASED)


def to_linear_rgba(rendering: Rendering, background: Background | None) -> Float[Tensor, "h w 4"]:
    """Linear premultiplied RGB and alpha of sRGB-encoded colours, put over the background (linear RGB) while encoded.

    Over a background the result is opaque.
    """
    alpha = rendering.alpha[..., None]
    if background is None:
        straight = rendering.rgb / alpha.clamp_min(1e-6)
        return torch.cat([decode_srgb(straight) * alpha, alpha], dim=-1)
    behind = encode_srgb(torch.tensor(background).to(rendering.rgb))
    return torch.cat([decode_srgb(rendering.rgb + (1 - alpha) * behind), torch.ones_like(alpha)], dim=-1)


def draw_front(path: Path, human: Human, px: int, compositing: Compositing = "linear") -> None:
    """Draw the human in the T pose from the front, px x px pixels with a transparent background."""
    primitives = place(human)
    draw(path, primitives, framing(primitives, 0, px, px), None, compositing)


def draw_back(path: Path, human: Human, px: int) -> None:
    """Draw the human as `draw_front_and_back` does, twice from behind: to the left and to the right."""
    _draw_side_by_side(path, human, px, (180 - THREE_QUARTERS, 180 + THREE_QUARTERS))


def draw_front_and_back(path: Path, human: Human, px: int) -> None:
    """Draw the human with lowered arms, front and back side by side, px x px pixels with a transparent background."""
    _draw_side_by_side(path, human, px, (THREE_QUARTERS, THREE_QUARTERS + 180))


def _draw_side_by_side(path: Path, human: Human, px: int, angles: tuple[float, float]) -> None:
    primitives = place(human, a_pose())
    views = []
    for degrees in angles:
        view = march(primitives, framing(primitives, degrees, px // 2, px))
        views.append(torch.cat([view.rgb, view.alpha[..., None]], dim=-1))
    rgba_to_png(path, torch.cat(views, dim=1), None)


def a_pose() -> BodyPose:
    """Return the pose with arms lowered to the sides, away from the body."""
    theta = torch.zeros(len(JOINT_NAMES), 3)
    theta[JOINT_NAMES.index("left_shoulder"), 2] = -ARMS_DOWN
    theta[JOINT_NAMES.index("right_shoulder"), 2] = ARMS_DOWN
    return BodyPose.from_axis_angle(theta.flatten())
