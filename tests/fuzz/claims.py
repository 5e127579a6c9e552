"""Small files that claim much, made in little memory."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

COLOUR, GREY = 2, 0
"""PNG's colour types."""


def png(width: int, height: int, colour: int = COLOUR, bits: int = 8) -> bytes:
    """A black PNG of any size."""
    row = b"\0" * (1 + width * (3 if colour == COLOUR else 1) * bits // 8)
    packer = zlib.compressobj(9)
    data = b"".join([*(packer.compress(row) for _ in range(height)), packer.flush()])
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", data), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


def many_scans(side: int, scans: int) -> bytes:
    """A progressive JPEG whose last scan is repeated."""
    from PIL import Image

    file = io.BytesIO()
    Image.new("L", (side, side)).save(file, "JPEG", progressive=True, quality=50)
    data = file.getvalue()
    last = data.rindex(b"\xff\xda")
    return data[:-2] + data[last:-2] * scans + data[-2:]


def zeros(path: Path, arrays: Mapping[str, tuple[str, tuple[int, ...]]], *, noise: int = 0, **small: object) -> Path:
    """A deflated .npz with zeros of these types and shapes, and `small` arrays.

    The first `noise` bytes of each are ones and zeros that do not compress, so that the file is large enough for more.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, (kind, shape) in arrays.items():
            header = {"descr": np.dtype(kind).str, "fortran_order": False, "shape": shape}
            left = int(np.prod(shape)) * np.dtype(kind).itemsize
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array_header_1_0(member, header)
                left -= member.write(np.random.default_rng(0).integers(0, 2, min(noise, left), np.uint8).tobytes())
                while left:
                    left -= member.write(bytes(min(left, 2**20)))
        for name, values in small.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asarray(values))
    return path
