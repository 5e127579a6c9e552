"""The picture that the child draws and Blender shows, in a file in shared memory that both map: nothing is copied."""

from __future__ import annotations

import contextlib
import itertools
import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..formats.regular_files import remove_file, remove_folder
from ..formats.whole_files import has_ended, writer

SHARED_MEMORY = Path("/dev/shm")
CHANNELS = 5
"""Combined (4) and depth."""
_PREFIX = "primdiffusion_"


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
    """A folder in shared memory for the frame and other files that the child reads; `close` removes it."""

    def __init__(self) -> None:
        self._folder: Path | None = None
        self._frame: Frame | None = None
        self._numbers = itertools.count(1)

    @property
    def folder(self) -> Path:
        """Made at first use."""
        if self._folder is None or not self._folder.is_dir():
            _sweep()
            self._folder = _new_folder(SHARED_MEMORY if os.access(SHARED_MEMORY, os.W_OK) else None)
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
            frame = self._frame = Frame(self._allocate(width * height * CHANNELS * 4), width, height)
        return frame

    def close(self) -> None:
        """Remove the folder."""
        folder, self._folder, self._frame = self._folder, None, None
        if folder is not None:
            remove_folder(folder, folder.parent)

    def _allocate(self, size: int) -> Path:
        """A file of `size` allocated bytes: otherwise a full memory file system would crash the process later."""
        name = f"{next(self._numbers)}.frame"
        try:
            return _reserve(self.folder / name, size)
        except OSError:
            if self.folder.parent != SHARED_MEMORY:
                raise
        self.close()
        self._folder = _new_folder(None)
        return _reserve(self._folder / name, size)


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
"""For all renders."""
