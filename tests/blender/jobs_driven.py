"""Works as a timer would see them through: background mode runs no timers."""

from __future__ import annotations

import time
from types import SimpleNamespace
from unittest.mock import MagicMock

from blender_primdiffusion.jobs.follow import follow
from blender_primdiffusion.jobs.queue import queue


def drive(seconds: float = 300.0) -> None:
    """The timer's part, by hand, until the line is empty."""
    end = time.monotonic() + seconds
    while follow() is not None:
        assert time.monotonic() < end
        time.sleep(0.01)


def until_running(seconds: float = 300.0) -> None:
    """Until the child has reported progress."""
    end = time.monotonic() + seconds
    while queue.request is None or queue.request.state != "running":
        assert time.monotonic() < end
        queue.tick()
        time.sleep(0.01)


def until_ready(seconds: float = 300.0) -> None:
    """Until the result is there, and built but for the step into the scene."""
    end = time.monotonic() + seconds
    while not queue.ready:
        assert time.monotonic() < end
        queue.tick()
        time.sleep(0.005)


def error_of(kind: str) -> str:
    """Why the last work of a kind failed; empty when it did not."""
    return queue.outcomes[kind].sentence


def notice_of(kind: str) -> str:
    """The news of the last work of a kind."""
    return queue.outcomes[kind].notice


class Layout:
    """Takes the calls of a UILayout, and remembers what they show; sections are closed unless they are `opened`."""

    def __init__(self, opened: bool = False, calls: list[tuple[str, str]] | None = None) -> None:
        self.opened, self.calls = opened, [] if calls is None else calls

    def _inside(self, **_: object) -> Layout:
        return Layout(self.opened, self.calls)

    row = column = box = split = grid_flow = _inside

    def panel(self, *_: object, **__: object) -> tuple[Layout, Layout | None]:
        return self._inside(), self._inside() if self.opened else None

    def label(self, text: str = "", **_: object) -> None:
        self.calls.append(("text", text))

    progress = label

    def operator(self, idname: str, **_: object) -> MagicMock:
        self.calls.append(("button", idname))
        return MagicMock()

    def prop(self, _owner: object, name: str, **_: object) -> None:
        self.calls.append(("prop", name))

    def __getattr__(self, name: str) -> MagicMock:
        return MagicMock()  # menus, lists and separators

    def of(self, *kinds: str) -> list[str]:
        """What was shown of "text", "button" (operators) and "prop" (names), in the order of drawing."""
        return [shown for kind, shown in self.calls if kind in kinds]


def shown(panel, context, *, opened: bool = False) -> list[str]:
    """Operators and texts that a panel, or a function for a section of one, draws; `opened` with closed sections."""
    layout = Layout(opened)
    if isinstance(panel, type):
        panel.draw(SimpleNamespace(layout=layout), context)
    else:
        panel(layout, context)
    return layout.of("text", "button")
