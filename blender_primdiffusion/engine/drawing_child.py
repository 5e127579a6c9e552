"""The child that draws renders, beside the one that generates: warm between frames, ended after a while without one.

It draws into a temporary file that both programs map: no pixels are sent.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import os
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.requests import Backend, ChildRequest
from ..files.regular_files import remove_file, remove_folder
from ..places import new_backend, preference

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


def end_when_idle(seconds: float) -> None:
    """End a child that has not drawn for so long. For a timer; never waits.

    Blender renders in a thread, which has the child to itself: no render can start while a timer runs.
    """
    if _child is None:
        return
    if bpy.app.is_job_running("RENDER"):
        _child.used_at = time.monotonic()
        return
    _child.backend.reap()
    if _child.backend.client is not None and seconds < time.monotonic() - _child.used_at:
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


CHANNELS = 5
"""Combined (4) and depth."""


class Frame:
    """One picture in a file, bottom row first, as in Blender's passes."""

    def __init__(self, path: Path, width: int, height: int):
        self.path, self.width, self.height = path, width, height
        self._values = np.memmap(path, np.float32, "r+", shape=(width * height * CHANNELS,))

    @property
    def combined(self) -> NDArray[np.float32]:
        """Linear, premultiplied RGBA, flat [height * width * 4]."""
        return self._values[: self.width * self.height * 4]

    @property
    def depth(self) -> NDArray[np.float32]:
        """Metres along the optical axis, flat [height * width]."""
        return self._values[self.width * self.height * 4 :]


class SharedFrames:
    """A folder among Blender's temporary files for the frame and what else the child reads; `close` removes it."""

    def __init__(self) -> None:
        self._folder: Path | None = None
        self._frame: Frame | None = None

    @property
    def folder(self) -> Path:
        """Made at first use."""
        self._folder = self._folder or Path(bpy.app.tempdir) / "primdiffusion_frames"
        self._folder.mkdir(parents=True, exist_ok=True)
        return self._folder

    def take(self, width: int, height: int) -> Frame:
        """The frame, which replaces one of another size. Raises OSError where there is no room for it."""
        frame = self._frame
        if frame is None or (frame.width, frame.height) != (width, height) or not frame.path.exists():
            self._frame = None  # Windows removes no mapped file
            if frame is not None:
                old, frame = frame.path, None
                with contextlib.suppress(PermissionError):  # its last user still maps it: it goes with the folder
                    remove_file(old, old.parent)
            path = _allocated(self.folder, width * height * CHANNELS * 4)
            frame = self._frame = Frame(path, width, height)
        return frame

    def close(self) -> None:
        """Remove the folder."""
        folder, self._folder, self._frame = self._folder, None, None
        if folder is not None:
            remove_folder(folder, folder.parent)


def _allocated(folder: Path, size: int) -> Path:
    """A new file of `size` allocated bytes: on a full disk, writing into a mapped one would crash the process."""
    descriptor, path = tempfile.mkstemp(".frame", dir=folder)
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(descriptor, 0, size)
        else:
            os.ftruncate(descriptor, size)
    except OSError:
        os.close(descriptor)
        remove_file(Path(path), folder)
        raise
    os.close(descriptor)
    return Path(path)


frames = SharedFrames()
"""For all renders."""
