"""When a viewport asks for what: coarse pictures while anything moves, finer ones at rest. Knows nothing of Blender."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

from ..worker.drawing import Drawing
from .frames import Frame
from .view import View

COARSENESS = (4, 2, 1)
"""Pixels of the window along a side of a drawn one, in the order in which they are drawn."""
FLUENT_S = 0.05
"""What a picture may take while things move. Where even a finer one would, on a graphics card, finer ones are drawn."""
REST_S = 0.12
"""Nothing has moved for this long: time for a finer picture."""


@dataclasses.dataclass(frozen=True)
class Wish:
    """A picture that a viewport would like to show; compared by `key`."""

    key: object
    """Equal for equal pictures."""
    params: dict[str, Any]
    """Of the request `draw`, without view, frame and region."""
    view: View
    """At the window's resolution."""
    region: tuple[int, int, int, int] | None
    """The wanted part [x, y, width, height], pixels of the window from the left and the bottom; None for all of it."""


@dataclasses.dataclass(frozen=True)
class Shown:
    """A finished picture."""

    wish: Wish
    coarseness: int
    frame: Frame


class Refinement:
    """Turns the newest wish into drawings, one at a time. `advance` is called often, from one thread; it never waits.

    While wishes change, each answer is followed by a coarse drawing of the newest one, so that pictures keep coming;
    a finer drawing that is overtaken by a new wish is given up.
    """

    def __init__(
        self,
        draw: Callable[[dict[str, Any]], Drawing],
        frame: Callable[[str, int, int], Frame],
        clock: Callable[[], float] = time.monotonic,
    ):
        """`draw` asks for a picture; `frame` gives a frame of this name, width and height that nobody else uses."""
        self._draw, self._frame, self._clock = draw, frame, clock
        self._wish: Wish | None = None
        self._changed_at = 0.0
        self._drawing: Drawing | None = None
        self._pending: Shown | None = None
        self._turn = 0
        self._died = False
        """The child has died since the last picture."""
        self._moving = COARSENESS[0]
        self.shown: Shown | None = None
        """The newest picture; its frame stays untouched until the next but one."""
        self.error = ""
        """Why the newest wish cannot be met; another wish is tried anew."""

    def want(self, wish: Wish) -> None:
        """The newest wish; nothing happens if it is the one already wanted."""
        if self._wish is not None and self._wish.key == wish.key:
            return
        self._wish, self._changed_at, self.error = wish, self._clock(), ""
        if self._drawing is not None and self._pending is not None and self._pending.coarseness < self._moving:
            self._drawing.cancel()

    @property
    def resting(self) -> bool:
        """The newest wish is met in full, or cannot be."""
        shown = self.shown
        met = shown is not None and shown.wish is self._wish and shown.coarseness == COARSENESS[-1]
        return self._drawing is None and (self._wish is None or met or bool(self.error))

    @property
    def starting(self) -> bool:
        """The first picture is under way, which takes a while: a child is started for it."""
        return self.shown is None and self._drawing is not None

    def advance(self) -> bool:
        """Takes in an answer and asks for the next picture; True when there is a new one to show, or an error."""
        news = self._take_answer()
        if self._drawing is None and self._wish is not None and not self.error:
            coarseness = self._next_coarseness()
            if coarseness is not None:
                news = self._ask(self._wish, coarseness) or news
        return news

    def give_up(self) -> None:
        """Cancels what is under way."""
        self._wish = None
        if self._drawing is not None:
            self._drawing.cancel()

    def _next_coarseness(self) -> int | None:
        if self.shown is None or self.shown.wish is not self._wish:
            return self._moving
        finer = [c for c in COARSENESS if c < self.shown.coarseness]
        rested = self._clock() - self._changed_at >= REST_S
        return finer[0] if finer and rested else None

    def _ask(self, wish: Wish, coarseness: int) -> bool:
        """Asks for a picture; True when that failed at once."""
        width, height = (max(1, -(-side // coarseness)) for side in (wish.view.width, wish.view.height))
        view = wish.view.scaled(width, height)
        region = None if wish.region is None else _scaled_region(wish.region, wish.view, view)
        self._turn = 1 - self._turn
        try:
            frame = self._frame(f"{self._turn}", *(region[2:] if region else (width, height)))
            params = {**wish.params, **view.params(), "region": region, "frame": str(frame.path)}
            self._drawing = self._draw(params)
        except (OSError, RuntimeError) as error:
            self.error = str(error)
            return True
        self._pending = Shown(wish, coarseness, frame)
        return False

    def _take_answer(self) -> bool:
        drawing, pending = self._drawing, self._pending
        if drawing is None or not drawing.finished:
            return False
        self._drawing = self._pending = None
        if drawing.state == "done":
            self.shown, self._died = pending, False
            self._pace(drawing)
            return True
        self._turn = 1 - self._turn  # the frame of what is shown must not be drawn into next
        if drawing.error is None or pending is None or pending.wish is not self._wish:
            return False
        if drawing.error.kind == "died" and not self._died:
            self._died = True  # the next drawing starts another; should that die too, the user is told
            return False
        self.error = str(drawing.error)
        return True

    def _pace(self, drawing: Drawing) -> None:
        """Choose how coarse the pictures are while things move, from what the last of them took."""
        seconds = drawing.result.get("seconds")
        if seconds is None or self.shown is None or self.shown.coarseness != self._moving:
            return
        place = COARSENESS.index(self._moving)
        if 4 * seconds < FLUENT_S:
            self._moving = COARSENESS[min(place + 1, len(COARSENESS) - 1)]
        elif seconds > 2 * FLUENT_S:
            self._moving = COARSENESS[max(place - 1, 0)]


def _scaled_region(region: tuple[int, int, int, int], full: View, coarse: View) -> list[int]:
    """The pixels of a coarse picture that touch a region of the full one."""
    x, y, width, height = region
    across, up = coarse.width / full.width, coarse.height / full.height
    left, bottom = int(x * across), int(y * up)
    right, top = -int(-(x + width) * across // 1), -int(-(y + height) * up // 1)
    right, top = min(max(right, left + 1), coarse.width), min(max(top, bottom + 1), coarse.height)
    return [left, bottom, right - left, top - bottom]
