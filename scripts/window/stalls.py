"""Measures how long the window is blocked, by the longest intervals between calls of a timer due every few ms."""

from __future__ import annotations

import time

import bpy

_EVERY_S = 0.005
_SHOWN = 5
_NOTICED_S = 0.1


class Stalls:
    """Measures from its creation until `end`. Everything that blocks Blender's main loop counts, ours or not."""

    def __init__(self) -> None:
        self._gaps: list[tuple[float, float]] = []
        self._last = self._now()
        self._timer = self._tick  # one object, because Blender identifies timers by identity
        bpy.app.timers.register(self._timer, first_interval=0.0, persistent=True)

    def end(self) -> str:
        """A summary: the longest gaps in ms, and the processor time of the main thread in each.

        The two differ on a busy machine, where the thread waits for a core.
        """
        self._tick()
        bpy.app.timers.unregister(self._timer)
        longest = sorted(self._gaps, reverse=True)[:_SHOWN]
        gaps = ", ".join(f"{1000 * wall:.0f} ({1000 * worked:.0f})" for wall, worked in longest)
        noticed = sum(wall for wall, _ in self._gaps if wall > _NOTICED_S)
        return f"longest {gaps} ms; {noticed:.1f} s of {sum(wall for wall, _ in self._gaps):.1f} s in gaps above 0.1 s"

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), time.thread_time()

    def _tick(self) -> float:
        now = self._now()
        self._gaps.append((now[0] - self._last[0], now[1] - self._last[1]))
        self._last = now
        return _EVERY_S
