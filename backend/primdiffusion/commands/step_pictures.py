"""Pictures of people in the making: the sampler's guess of the clean person, drawn small and not too often."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from primdiffusion.body.model import BodyPose
from primdiffusion.commands.progress import no_picture
from primdiffusion.diffusion.samplers import SamplerStep
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.human import Human, framing, place
from primdiffusion.render.image import rgba_to_png, to_png
from primdiffusion.render.march import march

INTERVAL_S = 0.4
"""Of work between two pictures."""
TIME_SHARE = 0.25
"""Of all time may go into pictures."""
KEPT = 2
"""Pictures: the reader of one may still be at it when the next one appears."""
THREE_QUARTERS = math.radians(20)
ARMS_DOWN = math.radians(62)

Show = Callable[[Tensor], Human | None]
"""The person of a guess x0 [b, ...] of the clean sample; None where there is nothing to see yet."""


class Allowance:
    """Says when the next picture may be drawn: `interval_s` after the last one, and so that they take TIME_SHARE."""

    def __init__(self, interval_s: float = INTERVAL_S) -> None:
        self._interval_s = interval_s
        self._began = self._last = time.perf_counter()
        self._spent, self._cost = 0.0, 0.0
        self._drawn = 0

    def granted(self) -> bool:
        """Whether a picture may be drawn now, if it takes as long as the last one did."""
        now = time.perf_counter()
        affordable = self._spent + self._cost <= TIME_SHARE * (now - self._began + self._cost)
        return now - self._last >= self._interval_s and affordable

    @contextlib.contextmanager
    def spending(self) -> Iterator[None]:
        """Around drawing. The first one counts for nothing: it loads what drawing the result needs, too."""
        began = time.perf_counter()
        yield
        self._last = time.perf_counter()
        if self._drawn:
            self._cost = self._last - began
            self._spent += self._cost
        self._drawn += 1


class PassingPictures(contextlib.AbstractContextManager):
    """Names in `folder` for pictures that come and go: each a new one, `kept` at a time, none in the end."""

    def __init__(self, folder: Path, kept: int) -> None:
        self._folder, self._kept = folder, kept
        self._named: list[Path] = []
        self._count = 0

    def next(self) -> Path:
        """The name of a further picture; the oldest one goes."""
        self._count += 1
        self._named.append(self._folder / f"passing_{self._count:04d}.png")
        self._remove(self._named[: -self._kept])
        self._named = self._named[-self._kept :]
        return self._named[-1]

    def __exit__(self, *_: object) -> None:
        """Removes what is left."""
        self._remove(self._named)

    def _remove(self, paths: list[Path]) -> None:
        for path in paths:
            with contextlib.suppress(OSError):  # Windows keeps what is being read; it goes with the folder
                path.unlink()


@contextlib.contextmanager
def step_pictures(folder: Path, px: int, show: Show) -> Iterator[Callable[[SamplerStep], str | None]]:
    """A function to call after each step, which may draw a picture of `px` x `px` pixels in `folder`; returns its path.

    None where there is no picture; px = 0 draws none. Those of the steps before vanish.
    """
    if px == 0:
        yield no_picture
        return
    allowance = Allowance()

    def picture(step: SamplerStep) -> str | None:
        if step.index + 1 == step.total or not allowance.granted():  # the result itself comes after the last step
            return None
        with allowance.spending():
            human = show(step.x0)
            if human is None:
                return None
            path = passing.next()
            draw_front(path, human, px)
        return str(path)

    with PassingPictures(folder, KEPT) as passing:
        yield picture


def draw_front(path: Path, human: Human, px: int) -> None:
    """The person in the T pose from in front on a transparent ground, px x px pixels."""
    primitives = place(human)
    to_png(path, march(primitives, framing(primitives, 0.0, px, px)), None)


def draw_front_and_back(path: Path, human: Human, px: int) -> None:
    """The person with lowered arms, from in front and from behind side by side on a transparent ground, px x px pixels.

    A standing person is half as wide as high: two of them fill a square.
    """
    primitives = place(human, a_pose())
    views = []
    for yaw in (THREE_QUARTERS, THREE_QUARTERS + math.pi):
        view = march(primitives, framing(primitives, yaw, px // 2, px))
        views.append(torch.cat([view.rgb, view.alpha[..., None]], dim=-1))
    rgba_to_png(path, torch.cat(views, dim=1), None)


def a_pose() -> BodyPose:
    """Arms lowered to the sides, away from the body."""
    theta = torch.zeros(len(JOINT_NAMES), 3)
    theta[JOINT_NAMES.index("left_shoulder"), 2] = -ARMS_DOWN
    theta[JOINT_NAMES.index("right_shoulder"), 2] = ARMS_DOWN
    return BodyPose.from_axis_angle(theta.flatten())
