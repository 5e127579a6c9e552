"""What pictures by the child share: the child that draws, and the files in shared memory that both processes map, so
that nothing is copied."""

from __future__ import annotations

import atexit
import contextlib
import itertools
import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..backend.drawing import IDLE_S, DrawingChild
from ..formats.regular_files import remove_file, remove_folder
from ..formats.whole_files import has_ended, writer
from ..places import new_backend, preference

SHARED_MEMORY = Path("/dev/shm")
CHANNELS = 5
"""Combined (4) and depth."""
_PREFIX = "primdiffusion_"
_FOLDER = "folder"


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

    def clear(self) -> None:
        """Fill the picture with zeros."""
        self._values[:] = 0


class SharedFrames:
    """A folder in shared memory for frames and other files that the child reads; `close` removes it.

    Several threads may use it, each with its own names: Blender renders in a thread while viewports draw.
    """

    def __init__(self) -> None:
        self._folders: dict[str, Path] = {}
        """At most one; two threads that need one at once agree by `setdefault`, which is atomic."""
        self._spare: dict[str, Frame] = {}
        self._numbers = itertools.count(1)
        self._dropped: list[Path] = []
        """Files of dropped frames that are still mapped, on Windows, which removes no mapped file."""

    @property
    def folder(self) -> Path:
        """Made at first use."""
        folder = self._folders.get(_FOLDER)
        if folder is not None and not folder.is_dir():
            self._folders.pop(_FOLDER, None)
            self._spare.clear()
            folder = None
        if folder is None:
            _sweep()
            new = _new_folder(SHARED_MEMORY if os.access(SHARED_MEMORY, os.W_OK) else None)
            folder = self._folders.setdefault(_FOLDER, new)
            if folder is not new:
                new.rmdir()
        return folder

    def take(self, name: str, width: int, height: int) -> Frame:
        """The frame of this name, reused if it has this size. Raises OSError where there is no room for it."""
        frame = self._spare.get(name)
        if frame is None or (frame.width, frame.height) != (width, height) or not frame.path.exists():
            self.drop(name)
            path = self._allocate(name, width * height * CHANNELS * 4)
            frame = self._spare[name] = Frame(path, width, height)
        return frame

    def drop(self, name: str) -> None:
        """Remove the frame of this name; its last user still maps it. On Windows its file goes at a later call."""
        frame = self._spare.pop(name, None)
        if frame is None:
            return
        dropped, self._dropped = [*self._dropped, frame.path], []
        del frame
        for path in dropped:
            try:
                remove_file(path, path.parent)
            except PermissionError:
                self._dropped.append(path)

    def close(self) -> None:
        """Remove the folder."""
        self._spare.clear()
        folder = self._folders.pop(_FOLDER, None)
        if folder is not None:
            remove_folder(folder, folder.parent)

    def _allocate(self, name: str, size: int) -> Path:
        """A file of `size` allocated bytes: otherwise a full memory file system would crash the process later."""
        file = f"{name}_{next(self._numbers)}.frame"  # a dropped frame may keep its name
        try:
            return _reserve(self.folder / file, size)
        except OSError:
            if self.folder.parent != SHARED_MEMORY:
                raise
        self.close()
        folder = self._folders.setdefault(_FOLDER, _new_folder(None))
        return _reserve(folder / file, size)


def _new_folder(within: Path | None) -> Path:
    return Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{writer()}_", dir=within))


def _reserve(path: Path, size: int) -> Path:
    remove_file(path, path.parent)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)  # follows no link
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(descriptor, 0, size)
        else:
            os.ftruncate(descriptor, size)
    except OSError:
        os.close(descriptor)
        remove_file(path, path.parent)
        raise
    os.close(descriptor)
    return path


def _sweep() -> None:
    """Remove what a killed Blender left in shared memory, which would otherwise stay until a restart."""
    for folder in SHARED_MEMORY.glob(f"{_PREFIX}*_*"):
        if has_ended(folder.name):
            with contextlib.suppress(OSError):
                remove_folder(folder, folder.parent)


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
