"""What outlives a single picture: the child that draws, and the shared memory it draws into."""

from __future__ import annotations

import atexit
import threading

from ..places import new_backend, preference
from ..worker.drawing import IDLE_S, DrawingChild
from .frames import Frames

frames = Frames()
"""Of all renders and viewports."""
_child: DrawingChild | None = None
_child_python = ""
_lock = threading.Lock()


def drawing_child() -> DrawingChild:
    """The engine's child, which runs beside the one that generates people; another preference makes another one."""
    global _child, _child_python
    python = preference("backend_python")
    with _lock:  # renders ask from a thread of their own
        if _child is None or python != _child_python:
            if _child is not None:
                _child.close()
            _child, _child_python = DrawingChild(new_backend(python), IDLE_S), python
        return _child


def child_pid() -> int | None:
    """The process of the engine's child, None while there is none."""
    return _child.pid if _child is not None else None


@atexit.register
def close() -> None:
    """Ends the child and frees the memory; the next picture starts anew."""
    global _child
    if _child is not None:
        _child.close()
        _child = None
    frames.close()
