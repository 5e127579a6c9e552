"""Works as a timer would see them through: background mode runs no timers."""

from __future__ import annotations

import time
from types import SimpleNamespace
from unittest.mock import MagicMock

from blender_primdiffusion.jobs.follow import follow
from blender_primdiffusion.jobs.queue import queue


def drive(seconds: float = 60.0) -> None:
    """The timer's part, by hand, until the line is empty."""
    end = time.monotonic() + seconds
    while follow() is not None:
        assert time.monotonic() < end
        time.sleep(0.01)


def until_running(seconds: float = 60.0) -> None:
    """Until the child has reported progress."""
    end = time.monotonic() + seconds
    while queue.request is None or queue.request.state != "running":
        assert time.monotonic() < end
        queue.tick()
        time.sleep(0.01)


def error_of(kind: str) -> str:
    """Why the last work of a kind failed; empty when it did not."""
    return queue.outcomes[kind].sentence


def notice_of(kind: str) -> str:
    """The news of the last work of a kind."""
    return queue.outcomes[kind].notice


def shown(panel, context, *, opened: bool = False) -> list[str]:
    """Operators and texts that a panel draws; `opened` with its closed sections."""
    texts: list[str] = []

    def layout() -> MagicMock:
        made = MagicMock()
        made.operator.side_effect = lambda idname, **kw: texts.append(idname) or MagicMock()
        made.label.side_effect = lambda **kw: texts.append(kw.get("text", ""))
        made.progress.side_effect = lambda **kw: texts.append(kw["text"])
        made.panel.side_effect = lambda *_, **__: (layout(), layout() if opened else None)
        for part in ("row", "column", "box", "grid_flow"):
            getattr(made, part).side_effect = lambda **_: layout()
        return made

    panel.draw(SimpleNamespace(layout=layout()), context)
    return texts
