"""The picture that the child draws and Blender shows, in a temporary file that both map: no pixels are sent."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.regular_files import remove_file, remove_folder

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

    def clear(self) -> None:
        """Fill the picture with zeros."""
        self._values[:] = 0


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
