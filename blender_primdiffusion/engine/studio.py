"""What pictures by the child share: the child that draws, and the shared memory it draws into."""

from __future__ import annotations

import atexit

from ..backend.drawing import IDLE_S, DrawingChild
from ..places import new_backend, preference
from .frames import SharedFrames

frames = SharedFrames()
"""For all renders and viewports."""
_children: dict[str, DrawingChild] = {}
"""By the preference for the backend's Python; one at a time."""


def drawing_child() -> DrawingChild:
    """The engine's child, separate from the one that generates; a new one when the preference changes."""
    python = preference("backend_python")
    child = _children.get(python)
    if child is None:  # Blender renders in a thread: of two callers at once, one makes the child
        child = _children.setdefault(python, DrawingChild(new_backend(python), IDLE_S))
        _close([other for other in list(_children) if other != python])
    return child


def advance() -> None:
    """Process the child's answers, and stop it when it has been idle. Never waits."""
    for child in list(_children.values()):
        child.advance()


def child_pid() -> int | None:
    """Process id of the engine's child, if any."""
    return next((child.pid for child in list(_children.values()) if child.pid is not None), None)


@atexit.register
def close() -> None:
    """Stop the child and free the memory; the next picture starts a new child."""
    _close(list(_children))
    frames.close()


def _close(pythons: list[str]) -> None:
    for python in pythons:
        child = _children.pop(python, None)
        if child is not None:
            child.close()
