"""What outlives a single picture: the child that draws, and the shared memory it draws into."""

from __future__ import annotations

import atexit

from ..places import new_backend, preference
from ..worker.drawing import IDLE_S, DrawingChild
from .frames import Frames

frames = Frames()
"""Of all renders and viewports."""
_children: dict[str, DrawingChild] = {}
"""By the preference for their Python; one at a time."""


def drawing_child() -> DrawingChild:
    """The engine's child, which runs beside the one that generates people; another preference makes another one."""
    python = preference("backend_python")
    child = _children.get(python)
    if child is None:  # renders ask from a thread of Blender's: one of two that ask at once makes it
        child = _children.setdefault(python, DrawingChild(new_backend(python), IDLE_S))
        _close([other for other in list(_children) if other != python])
    return child


def advance() -> None:
    """Follow what the child draws, and end an idle one. Never waits."""
    for child in list(_children.values()):
        child.advance()


def child_pid() -> int | None:
    """The process of the engine's child, None while there is none."""
    return next((child.pid for child in list(_children.values()) if child.pid is not None), None)


@atexit.register
def close() -> None:
    """Ends the child and frees the memory; the next picture starts anew."""
    _close(list(_children))
    frames.close()


def _close(pythons: list[str]) -> None:
    for python in pythons:
        child = _children.pop(python, None)
        if child is not None:
            child.close()
