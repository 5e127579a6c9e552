"""Measures how long the window is blocked, by the longest intervals between calls of a timer due every few ms."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from importlib import import_module

import bpy

_EVERY_S = 0.005
_SHOWN = 5
_NOTICED_S = 0.1
_OURS = (
    ("jobs.follow", "", "apply_ready_result"),
    ("jobs.volumes", "VolumesJob", "advance"),
    ("engine.gpu.overlay", "Overlay", "advance"),
    ("engine.gpu.overlay", "Overlay", "draw"),
)
"""Module, class and function of what the extension does in the main loop and in draw handlers while a human enters."""
_ours_s = dict.fromkeys((f"{owner or module}.{function}" for module, owner, function in _OURS), 0.0)


@dataclasses.dataclass(frozen=True)
class Gap:
    """An interval between two calls of the timer; all times in seconds."""

    end: float
    wall: float
    worked: float
    """Processor time of the main thread."""
    ours: float
    """Within the functions of `_OURS`; the rest is Blender's events, evaluation and drawing."""
    mostly: str
    """The function of those that took longest."""


def measure_extension(module: str) -> None:
    """From now on, count the time within the extension's functions. Call it once in a session."""
    for name, owner, function in _OURS:
        found = import_module(f"{module}.{name}")
        found = getattr(found, owner) if owner else found
        setattr(found, function, _counted(getattr(found, function), f"{owner or name}.{function}"))


def _counted(function: Callable, name: str) -> Callable:
    @functools.wraps(function)
    def call(*given: object, **named: object) -> object:
        began = time.perf_counter()
        try:
            return function(*given, **named)
        finally:
            _ours_s[name] += time.perf_counter() - began

    return call


class Stalls:
    """Measures from its creation until `end`. Everything that blocks Blender's main loop counts, ours or not."""

    def __init__(self, events: Mapping[str, Callable[[], bool]] | None = None) -> None:
        """`events`: conditions, of which the first time each is met is noted."""
        self.gaps: list[Gap] = []
        self.met: dict[str, float] = {}
        """By the name of the event."""
        self._events = dict(events or {})
        self._last = self._now()
        self._timer = self._tick  # one object, because Blender identifies timers by identity
        bpy.app.timers.register(self._timer, first_interval=0.0, persistent=True)

    def end(self) -> str:
        """A summary: the longest gaps in ms, and in each the processor time of the main thread and, if it is measured,
        the time within the extension and the function that took most of it.

        Gap and processor time differ on a busy machine, where the thread waits for a core, and while software OpenGL
        draws in its own threads.
        """
        self._tick()
        bpy.app.timers.unregister(self._timer)
        longest = sorted(self.gaps, key=lambda gap: -gap.wall)[:_SHOWN]
        gaps = ", ".join(f"{_ms(gap.wall)} ({_ms(gap.worked)}; {_ms(gap.ours)} {gap.mostly})" for gap in longest)
        noticed = sum(gap.wall for gap in self.gaps if gap.wall > _NOTICED_S)
        whole = sum(gap.wall for gap in self.gaps)
        return f"longest {gaps} ms; {noticed:.1f} s of {whole:.1f} s in gaps above 0.1 s"

    def between(self, first: str, last: str) -> list[Gap]:
        """Gaps after the event `first` until `last`."""
        return [gap for gap in self.gaps if self.met[first] < gap.end <= self.met[last]]

    @staticmethod
    def _now() -> tuple[float, float, dict[str, float]]:
        return time.perf_counter(), time.thread_time(), dict(_ours_s)

    def _tick(self) -> float:
        (then, then_worked, before), (now, worked, after) = self._last, self._now()
        ours = {name: after[name] - before[name] for name in after}
        longest = max(ours, key=ours.__getitem__)
        self.gaps.append(Gap(now, now - then, worked - then_worked, sum(ours.values()), longest))
        self._last = now, worked, after
        for name in [name for name, met in self._events.items() if met()]:
            self.met[name] = now
            del self._events[name]
        return _EVERY_S


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.0f}"
