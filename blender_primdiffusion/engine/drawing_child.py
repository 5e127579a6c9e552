"""The child that draws renders, beside the one that generates: warm between frames, ended after a while without one."""

from __future__ import annotations

import atexit
import dataclasses
import time
from collections.abc import Mapping
from typing import Any

import bpy

from ..backend.requests import Backend, ChildRequest
from ..places import new_backend, preference
from .shared_frames import frames

IDLE_S = 600.0
"""A child at rest holds about half a gigabyte; starting one takes seconds."""
CANCEL_PATIENCE_S = 15.0
"""A cancel takes effect at the end of a band; a child that takes longer than this is ended."""


@dataclasses.dataclass
class _Child:
    python: str
    """The preference that it was started for."""
    backend: Backend
    request: ChildRequest | None = None
    used_at: float = 0.0


_child: _Child | None = None


def draw(params: Mapping[str, Any]) -> ChildRequest:
    """Request a picture (`params` of the request `draw`, docs/design/protocol.md)."""
    global _child
    python = preference("backend_python")
    if _child is None or _child.python != python or (_child.request and not _child.request.finished):
        _end()  # unfinished: its render ended with a defect
        _child = _Child(python, new_backend(python))
    _child.used_at = time.monotonic()
    _child.request = ChildRequest(_child.backend, "draw", params, CANCEL_PATIENCE_S)
    return _child.request


def end_when_idle() -> None:
    """End a child that has not drawn for IDLE_S. For a timer; never waits.

    Blender renders in a thread, which has the child to itself: no render can start while a timer runs.
    """
    if _child is None:
        return
    if bpy.app.is_job_running("RENDER"):
        _child.used_at = time.monotonic()
        return
    _child.backend.reap()
    if _child.backend.client is not None and time.monotonic() - _child.used_at > IDLE_S:
        _child.backend.release()


def child_pid() -> int | None:
    """Process id of the child, busy or warm, if any."""
    client = _child.backend.client if _child is not None else None
    return client.pid if client is not None else None


@atexit.register
def close() -> None:
    """Cancel the picture, end the child and free the memory; the next picture starts a new child."""
    _end()
    frames.close()


def _end() -> None:
    global _child
    child, _child = _child, None
    if child is None:
        return
    if child.request is not None:
        child.request.cancel()
    child.backend.shutdown()
