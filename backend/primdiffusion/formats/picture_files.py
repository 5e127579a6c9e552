"""Encoding of capture images, and PNG files without an imaging library."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .regular_files import TooLargeError, open_regular
from .whole_files import replacing

DEPTH_UNIT = 0.00025
"""Metres per unit of a depth file, which reaches 16.38 m."""
LARGEST_PICTURE = 512 * 2**20
"""Bytes."""
_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"\x00\x00\x00\x00IEND\xaeB\x60\x82"
_JPEG, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


def write_png(path: Path, pixels: NDArray) -> None:
    """Encode [H, W], [H, W, 3] or [H, W, 4], uint8 or uint16, as an unfiltered PNG: the same bytes on every machine."""
    pixels = np.asarray(pixels)
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.shape[2:] not in ((), (3,), (4,)):
        raise ValueError(
            f"a PNG of {pixels.dtype} {pixels.shape} cannot be written: give uint8 or uint16 [H, W(, 3 or 4)]"
        )
    bits, (height, width) = 8 * pixels.dtype.itemsize, pixels.shape[:2]
    rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">"))).view(np.uint8).reshape(height, -1)
    filtered = np.concatenate([np.zeros((height, 1), np.uint8), rows], axis=1)
    header = struct.pack(">IIBBBBB", width, height, bits, {(): 0, (3,): 2, (4,): 6}[pixels.shape[2:]], 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 6))]
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(_PNG)
        for kind, data in chunks:
            file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))
        file.write(_PNG_END)


def depth_steps(depth: NDArray) -> NDArray[np.uint16]:
    """Convert metres along the optical axis to units of a depth file; 0 if not finite or out of range."""
    steps = np.where(np.isfinite(depth), np.round(np.nan_to_num(depth, posinf=0) / DEPTH_UNIT), 0)
    return np.where((steps > 0) & (steps < 65536), steps, 0).astype(np.uint16)


def normal_bytes(normal: NDArray, covered: NDArray) -> NDArray[np.uint8]:
    """Convert world normals [H, W, 3] to values of a normal file, 0 outside `covered` [H, W]."""
    values = np.zeros(normal.shape, np.uint8)
    values[covered] = np.round((np.clip(normal[covered], -1, 1) + 1) * 127.5)
    return values


def is_whole_picture(path: Path) -> bool:
    """Return whether a .png or .jpg has its first and last bytes; does not decode it."""
    head, tail = (_PNG, _PNG_END) if path.suffix == ".png" else (_JPEG, _JPEG_END)
    try:
        with open_regular(path, LARGEST_PICTURE) as file:
            begins = file.read(len(head)) == head
            file.seek(-len(tail), os.SEEK_END)
            return begins and file.read() == tail
    except (OSError, TooLargeError):
        return False
