"""PNG files of arrays, without a data-block of Blender's: the open file stays as it is."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_RGBA_8_BITS = b"\x08\x06\x00\x00\x00"


def write_png(path: Path, picture: NDArray) -> None:
    """Write RGBA [H, W, 4] from 0 to 1, as it is to be seen, straight alpha, bottom row first. Raises OSError.

    The file is there whole or not at all.
    """
    height, width, _ = picture.shape
    rows = np.round(np.clip(picture[::-1], 0, 1) * 255).astype(np.uint8).reshape(height, -1)
    unfiltered = np.insert(rows, 0, 0, axis=1).tobytes()  # each row begins with its filter
    header = struct.pack(">II", width, height) + _RGBA_8_BITS
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(unfiltered)), (b"IEND", b""))
    unfinished = path.with_name(f".{path.name}.part")
    try:
        unfinished.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*chunk) for chunk in chunks))
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
