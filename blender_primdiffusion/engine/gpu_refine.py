"""Which picture a view marches on the GPU when: coarse ones while anything moves, finer ones at rest, then antialiased.

Needs no Blender. `advance` is called while a view is drawn, where Blender gives a GPU context, and marches for about
SLICE_S, so that a slow GPU does not stall the window.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from .refine import COARSENESS, FLUENT_S, REST_S
from .view import PinholeView

SLICE_S = 0.1
SAMPLES = 8
"""Pictures that are averaged when nothing moves, each with its rays elsewhere in the pixels."""
SLOW_S, SLOW_SAMPLES = 0.5, 4
"""Where a full picture takes longer, fewer are averaged."""
_FIRST_WORK = 2.0**15
_GROWTH = 4.0


class Pass(Protocol):
    """One picture that is being marched, such as a `GpuMarch`."""

    def advance(self, work: float) -> bool:
        """March for about this work, in pixels times boxes; True when the picture is complete."""
        ...

    def wait(self) -> None:
        """Return when the GPU has finished what it was given."""
        ...


@dataclasses.dataclass(frozen=True)
class MarchRequest:
    """A picture that a view should show; compared by `key`."""

    key: object
    """Equal for equal pictures."""
    view: PinholeView
    """At the window's resolution."""
    begin: Callable[[PinholeView], Pass]
    """Starts a picture: from this view with fewer pixels, or with its rays elsewhere in the pixels."""


@dataclasses.dataclass(frozen=True)
class ShownMarch:
    """A finished picture."""

    request: MarchRequest
    coarseness: int
    sample: int
    """0 for rays through the pixels' centres; picture number n of those to be averaged."""
    picture: Pass


class GpuRefinement:
    """Marches the newest request, one picture at a time."""

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, coarsest: int = COARSENESS[0], samples: int = SAMPLES
    ):
        """`coarsest`, a power of two, is the coarseness while anything moves; of `samples` pictures at rest."""
        self._clock, self._coarsest, self._samples = clock, coarsest, samples
        self._request: MarchRequest | None = None
        self._changed_at = 0.0
        self._pending: ShownMarch | None = None
        self._seconds, self._pixel_seconds = 0.0, np.inf
        """Of the pending picture so far, and of a pixel of the last one."""
        self._work = _FIRST_WORK
        self.shown: ShownMarch | None = None

    def want(self, request: MarchRequest) -> None:
        """Set the newest request; an equal one changes nothing."""
        if self._request is not None and self._request.key == request.key:
            return
        self._request, self._changed_at = request, self._clock()
        if self._pending is not None and self._pending.coarseness < self._moving(self._pending.request.view):
            self._pending = None

    @property
    def resting(self) -> bool:
        """Whether the newest request is drawn in full."""
        return self._request is None or (self._pending is None and self._next() is None)

    @property
    def due(self) -> bool:
        """Whether `advance` would march now: it waits for a while before it begins finer pictures."""
        if self._request is None or self._pending is not None:
            return self._pending is not None
        fresh = self.shown is None or self.shown.request is not self._request
        return self._next() is not None and (fresh or self._clock() - self._changed_at >= REST_S)

    def advance(self) -> bool:
        """March for about SLICE_S; True when there is a new picture in `shown`. Raises what `begin` raises."""
        end = self._clock() + SLICE_S
        while self.due and self._clock() < end:
            self._pending = self._pending or self._begin(self._request)
            if self._march(self._pending):
                self.shown, self._pending = self._pending, None
                return True
        return False

    def _moving(self, view: PinholeView) -> int:
        """How coarse pictures are while the scene moves, from the time of the last one."""
        pixels = view.width * view.height
        coarseness = 1
        while coarseness < self._coarsest and pixels / coarseness**2 * self._pixel_seconds > FLUENT_S:
            coarseness *= 2
        return coarseness

    def _next(self) -> tuple[int, int] | None:
        """Coarseness and number of the picture after the shown one; None after the last."""
        shown = self.shown
        if shown is None or shown.request is not self._request:
            return self._moving(self._request.view), 0
        if shown.coarseness > 1:
            return shown.coarseness // 2, 0
        view = self._request.view
        slow = view.width * view.height * self._pixel_seconds > SLOW_S
        samples = min(self._samples, SLOW_SAMPLES) if slow else self._samples
        return (1, shown.sample + 1) if shown.sample + 1 < samples else None

    def _begin(self, request: MarchRequest) -> ShownMarch:
        coarseness, sample = self._next()
        view = request.view.scaled(*(-(-side // coarseness) for side in (request.view.width, request.view.height)))
        began = self._clock()
        begun = ShownMarch(request, coarseness, sample, request.begin(jittered(view, sample)))
        self._seconds = self._clock() - began
        return begun

    def _march(self, pending: ShownMarch) -> bool:
        """A slice of the pending picture; True when it is complete."""
        began = self._clock()
        done = pending.picture.advance(self._work)
        pending.picture.wait()
        seconds = self._clock() - began
        self._seconds += seconds
        growth = SLICE_S / 2 / max(seconds, 1e-6)
        if growth < 1 or not done:  # the last slice is a rest
            self._work *= min(max(growth, 1 / _GROWTH), _GROWTH)
        if done:
            view = pending.request.view
            self._pixel_seconds = self._seconds * pending.coarseness**2 / (view.width * view.height)
        return done


def jittered(view: PinholeView, sample: int) -> PinholeView:
    """The view with its rays elsewhere in the pixels: through the centres for sample 0."""
    if sample == 0:
        return view
    right, down = (np.array([0.754877666, 0.569840291]) * sample + 0.5) % 1 - 0.5  # R2, a low-discrepancy sequence
    intrinsics = view.intrinsics.copy()
    intrinsics[:2, 2] += right, down
    return dataclasses.replace(view, intrinsics=intrinsics)
