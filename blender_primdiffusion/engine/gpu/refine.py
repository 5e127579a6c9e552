"""Which picture a view shows when: a coarse one at once while anything moves, finer ones at rest, then antialiased.

Needs no Blender. `advance` is called where Blender gives a GPU context, and marches for about SLICE_S, so that a slow
GPU does not stall the window.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..view import PinholeView

SLICE_S = 0.1
FLUENT_S = 0.05
"""Time for a picture while the scene moves: the finest that takes no longer is marched, else the coarsest."""
REST_S = 0.12
"""A finer picture is begun when nothing has moved for this long."""
COARSENESS = (8, 4, 2, 1)
"""Pixels of the window per marched pixel along a side, in the order of marching."""
SAMPLES = 8
"""Pictures that are averaged when nothing moves, each with its rays elsewhere in the pixels."""
SLOW_S, SLOW_SAMPLES = 0.5, 4
"""Where a full picture takes longer, fewer are averaged."""
_FIRST_WORK = 2.0**15
_GROWTH = 4.0


@dataclasses.dataclass(frozen=True)
class MarchRequest:
    """A picture that a view should show; compared by `key`."""

    key: object
    """Equal for equal pictures."""
    view: PinholeView
    """At the window's resolution."""
    begin: Callable[[PinholeView, int], Any]
    """Starts a picture, a `GpuMarch` or `GpuPicture`: from this view with fewer pixels, or with its rays elsewhere in
    the pixels, and with steps along rays that are longer by this factor."""


@dataclasses.dataclass(frozen=True)
class ShownMarch:
    """A finished picture."""

    request: MarchRequest
    coarseness: int
    """One of COARSENESS."""
    sample: int
    """0 for rays through the pixels' centres; picture number n of those to be averaged."""
    picture: Any


class GpuRefinement:
    """Marches the newest request at once, coarsely where the GPU is slow; then finely."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, samples: int = SAMPLES):
        """A refinement of `samples` pictures at rest."""
        self._clock, self._samples = clock, samples
        self._request: MarchRequest | None = None
        self._changed_at = 0.0
        self._pending: ShownMarch | None = None
        self._seconds, self._pixel_seconds = 0.0, np.inf
        """Seconds for the pending picture so far, and for a pixel of the last one."""
        self._work = _FIRST_WORK
        self.shown: ShownMarch | None = None

    def want(self, request: MarchRequest) -> None:
        """Set the newest request; an equal one changes nothing."""
        if self._request is None or self._request.key != request.key:
            self._request, self._changed_at, self._pending = request, self._clock(), None

    @property
    def fresh(self) -> bool:
        """Whether there is no picture yet of the newest request: `advance` makes one that is whole."""
        return self._request is not None and (self.shown is None or self.shown.request.key != self._request.key)

    @property
    def resting(self) -> bool:
        """Whether the newest request is drawn as finely as can be."""
        return not self.fresh and self._pending is None and self._next() is None

    @property
    def due(self) -> bool:
        """Whether `advance` would do anything now: it waits for a while before it begins finer pictures."""
        rested = self._clock() - self._changed_at >= REST_S
        return self.fresh or self._pending is not None or (rested and self._next() is not None)

    def advance(self) -> bool:
        """Make a first picture, or march for about SLICE_S; True when there is a new picture. Raises what `begin` and
        what it starts raise."""
        if self.fresh:
            self.shown = self._at_once(self._request)
            return True
        end = self._clock() + SLICE_S
        while self.due and self._clock() < end:
            self._pending = self._pending or self._begin(self._request, *self._next())
            if self._march(self._pending):
                self.shown, self._pending = self._pending, None
                return True
        return False

    def _at_once(self, request: MarchRequest) -> ShownMarch:
        coarseness = self._finest_fluent(request.view, COARSENESS)
        picture, end = self._begin(request, coarseness, 0), self._clock() + 2 * FLUENT_S
        while not self._march(picture):
            if coarseness != COARSENESS[0] and self._clock() > end:  # slower than the last one
                coarseness = COARSENESS[0]
                picture = self._begin(request, coarseness, 0)
        return picture

    def _finest_fluent(self, view: PinholeView, among: tuple[int, ...]) -> int:
        """The finest that fits into FLUENT_S by the time of the last picture, or the first."""
        seconds = view.width * view.height * self._pixel_seconds
        return next((finer for finer in reversed(among) if seconds / finer**2 <= FLUENT_S), among[0])

    def _next(self) -> tuple[int, int] | None:
        """Coarseness and number of the picture after the shown one; None after the last."""
        shown, request = self.shown, self._request
        if shown is None or request is None:
            return None
        if finer := COARSENESS[COARSENESS.index(shown.coarseness) + 1 :]:
            return self._finest_fluent(request.view, finer), 0
        slow = request.view.width * request.view.height * self._pixel_seconds > SLOW_S
        samples = min(self._samples, SLOW_SAMPLES) if slow else self._samples
        return (1, shown.sample + 1) if shown.sample + 1 < samples else None

    def _begin(self, request: MarchRequest, coarseness: int, sample: int) -> ShownMarch:
        size = [-(-side // coarseness) for side in (request.view.width, request.view.height)]
        view = jittered(request.view.scaled(*size), sample)
        began = self._clock()
        begun = ShownMarch(request, coarseness, sample, request.begin(view, coarseness))
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
