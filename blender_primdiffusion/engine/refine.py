"""Which picture a viewport requests when: coarse ones while anything moves, finer ones at rest. Needs no Blender."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

from ..backend.drawing import Drawing
from .studio import Frame
from .view import PinholeView

COARSENESS = (4, 2, 1)
"""Pixels of the window per drawn pixel along a side, in the order of drawing."""
FLUENT_S = 0.05
"""Time for a picture while the scene moves. Where finer ones take no longer, as on a GPU, finer ones are drawn."""
REST_S = 0.12
"""A finer picture is drawn when nothing has moved for this long."""


@dataclasses.dataclass(frozen=True)
class ViewRequest:
    """A picture that a viewport should show; compared by `key`."""

    key: object
    """Equal for equal pictures."""
    params: dict[str, Any]
    """Parameters of the child's `draw`, without view, frame and region."""
    view: PinholeView
    """At the window's resolution."""
    region: tuple[int, int, int, int] | None
    """The part to draw [x, y, width, height], pixels of the window from the left and the bottom; None for all of it."""


@dataclasses.dataclass(frozen=True)
class ShownPicture:
    """A finished picture."""

    request: ViewRequest
    coarseness: int
    frame: Frame


class Refinement:
    """Draws the newest request, one drawing at a time. `advance` is called often, from one thread, and never waits.

    While requests change, each answer is followed by a coarse drawing of the newest one, so that pictures keep coming;
    a finer drawing is cancelled when a new request arrives.
    """

    def __init__(
        self,
        draw: Callable[[dict[str, Any]], Drawing],
        frame: Callable[[str, int, int], Frame],
        clock: Callable[[], float] = time.monotonic,
    ):
        """`draw` starts a drawing; `frame` gives a frame of this name, width and height that has no other user."""
        self._draw, self._frame, self._clock = draw, frame, clock
        self._request: ViewRequest | None = None
        self._changed_at = 0.0
        self._drawing: Drawing | None = None
        self._pending: ShownPicture | None = None
        self._turn = 0
        self._died = False
        """Whether the child has died since the last picture."""
        self._moving = COARSENESS[0]
        self.shown: ShownPicture | None = None
        """The newest picture; its frame is not drawn into until the next but one."""
        self.error = ""
        """Why the newest request cannot be drawn; another request is tried again."""

    def want(self, request: ViewRequest) -> None:
        """Set the newest request; an equal one changes nothing."""
        if self._request is not None and self._request.key == request.key:
            return
        self._request, self._changed_at, self.error = request, self._clock(), ""
        if self._drawing is not None and self._pending is not None and self._pending.coarseness < self._moving:
            self._drawing.cancel()

    @property
    def resting(self) -> bool:
        """Whether the newest request is drawn in full, or cannot be."""
        shown = self.shown
        drawn = shown is not None and shown.request is self._request and shown.coarseness == COARSENESS[-1]
        return self._drawing is None and (self._request is None or drawn or bool(self.error))

    @property
    def starting(self) -> bool:
        """Whether the first picture is being drawn, which takes a while: a child is started for it."""
        return self.shown is None and self._drawing is not None

    def advance(self) -> bool:
        """Process an answer and start the next drawing; True when there is a new picture to show, or an error."""
        news = self._take_answer()
        if self._drawing is None and self._request is not None and not self.error:
            coarseness = self._next_coarseness()
            if coarseness is not None:
                news = self._ask(self._request, coarseness) or news
        return news

    def give_up(self) -> None:
        """Cancel the current drawing."""
        self._request = None
        if self._drawing is not None:
            self._drawing.cancel()

    def _next_coarseness(self) -> int | None:
        if self.shown is None or self.shown.request is not self._request:
            return self._moving
        finer = [c for c in COARSENESS if c < self.shown.coarseness]
        rested = self._clock() - self._changed_at >= REST_S
        return finer[0] if finer and rested else None

    def _ask(self, request: ViewRequest, coarseness: int) -> bool:
        """Start a drawing; True when that failed at once."""
        width, height = (max(1, -(-side // coarseness)) for side in (request.view.width, request.view.height))
        view = request.view.scaled(width, height)
        region = None if request.region is None else _scaled_region(request.region, request.view, view)
        self._turn = 1 - self._turn
        try:
            frame = self._frame(f"{self._turn}", *(region[2:] if region else (width, height)))
            params = {**request.params, **view.params(), "region": region, "frame": str(frame.path)}
            self._drawing = self._draw(params)
        except (OSError, RuntimeError) as error:
            self.error = str(error)
            return True
        self._pending = ShownPicture(request, coarseness, frame)
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
        if drawing.error is None or pending is None or pending.request is not self._request:
            return False
        if drawing.error.kind == "died" and not self._died:
            self._died = True  # the next drawing starts another; if that dies too, its error is shown
            return False
        self.error = str(drawing.error)
        return True

    def _pace(self, drawing: Drawing) -> None:
        """Choose how coarse pictures are while the scene moves, from the time of the last one."""
        seconds = drawing.result.seconds
        if seconds is None or self.shown is None or self.shown.coarseness != self._moving:
            return
        index = COARSENESS.index(self._moving)
        if 4 * seconds < FLUENT_S:
            self._moving = COARSENESS[min(index + 1, len(COARSENESS) - 1)]
        elif seconds > 2 * FLUENT_S:
            self._moving = COARSENESS[max(index - 1, 0)]


def _scaled_region(region: tuple[int, int, int, int], full: PinholeView, coarse: PinholeView) -> list[int]:
    """The pixels of a coarse picture that touch a region of the full one."""
    x, y, width, height = region
    across, up = coarse.width / full.width, coarse.height / full.height
    left, bottom = int(x * across), int(y * up)
    right, top = -int(-(x + width) * across // 1), -int(-(y + height) * up // 1)
    right, top = min(max(right, left + 1), coarse.width), min(max(top, bottom + 1), coarse.height)
    return [left, bottom, right - left, top - bottom]
