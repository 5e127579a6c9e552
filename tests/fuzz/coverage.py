"""Which lines of the two programs reading has come to, and whether in a new order."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = tuple(f"{ROOT / name}{os.sep}" for name in ("backend", "blender_primdiffusion"))


class Coverage:
    """While it is entered, lines are noted that this thread runs, of files whose paths begin as one of `programs`."""

    def __init__(self, programs: tuple[str, ...] = PROGRAMS) -> None:
        self._programs = programs
        self.has_news = False
        """A line was reached from a line that has never led to it, since this was last set to False."""
        self._seen: dict[CodeType, set[tuple[int, int]]] = {}
        """Pairs of lines by function; empty for functions of others."""
        self._told: set[str] = set()

    def __enter__(self) -> None:
        sys.settrace(self._called)

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def new_lines(self) -> list[str]:
        """Lines that were reached since the last call for the first time, as file:number."""
        now = {f"{code.co_filename}:{line}" for code, pairs in self._seen.items() for _, line in pairs} - self._told
        self._told |= now
        return sorted(now)

    def _called(self, frame: FrameType, _event: str, _argument: Any) -> Any:
        code = frame.f_code
        seen = self._seen.get(code)
        if seen is None:
            if not code.co_filename.startswith(self._programs):
                return None
            seen = self._seen[code] = set()
        last = 0

        def step(frame: FrameType, event: str, _argument: Any) -> Any:
            nonlocal last
            if event == "line":
                pair, last = (last, frame.f_lineno), frame.f_lineno
                if pair not in seen:
                    seen.add(pair)
                    self.has_news = True
            return step

        return step
