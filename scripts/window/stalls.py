"""How long the window stands still: the longest times between two calls of a timer that is due every few
milliseconds."""

from __future__ import annotations

import time

import bpy

_EVERY_S = 0.005
_SHOWN = 5
_NOTICED_S = 0.1


class Stalls:
    """Measures from its making until `end`. Whatever keeps Blender's main loop, ours or not, counts."""

    def __init__(self) -> None:
        self._gaps: list[tuple[float, float]] = []
        self._last = self._now()
        self._timer = self._tick  # one object: Blender tells timers apart by identity
        bpy.app.timers.register(self._timer, first_interval=0.0, persistent=True)

    def end(self) -> str:
        """For people: the longest gaps in milliseconds, and how long the main thread truly worked in each: on a busy
        machine it waits for its turn."""
        self._tick()
        bpy.app.timers.unregister(self._timer)
        longest = sorted(self._gaps, reverse=True)[:_SHOWN]
        told = ", ".join(f"{1000 * wall:.0f} ({1000 * worked:.0f})" for wall, worked in longest)
        noticed = sum(wall for wall, _ in self._gaps if wall > _NOTICED_S)
        return f"longest {told} ms; {noticed:.1f} s of {sum(wall for wall, _ in self._gaps):.1f} s in gaps above 0.1 s"

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), time.thread_time()

    def _tick(self) -> float:
        now = self._now()
        self._gaps.append((now[0] - self._last[0], now[1] - self._last[1]))
        self._last = now
        return _EVERY_S
