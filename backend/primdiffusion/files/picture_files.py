"""Encoding of capture images, and PNG and OpenEXR files without an imaging library."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .whole_files import atomic_replace

DEPTH_UNIT = 0.00025
"""Metres per unit of a depth file, which reaches 16.38 m."""
_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"\x00\x00\x00\x00IEND\xaeB\x60\x82"
_EXR, _EXR_LINES = b"\x76\x2f\x31\x01\x02\x00\x00\x00", 16
"""Magic number and version 2; lines of a chunk compressed by ZIP."""
_EXR_CHANNEL = b"Y"
"""Luminance: the name that programs for pictures read too."""


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
    with atomic_replace(path) as partial, partial.open("wb") as file:
        file.write(_PNG)
        for kind, data in chunks:
            file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))
        file.write(_PNG_END)


def write_exr(path: Path, values: NDArray) -> None:
    """Write [H, W] as an OpenEXR of one float32 channel Y, compressed by ZIP: the same bytes on every machine."""
    values = np.ascontiguousarray(values, "<f4")
    if values.ndim != 2:
        raise ValueError(f"an OpenEXR of {values.shape} cannot be written: give [H, W]")
    header = _exr_header(*values.shape)
    chunks = [_exr_chunk(first, values[first : first + _EXR_LINES]) for first in range(0, len(values), _EXR_LINES)]
    sizes = [len(header) + 8 * len(chunks), *map(len, chunks[:-1])]
    with atomic_replace(path) as partial, partial.open("wb") as file:
        file.write(header)
        file.write(np.cumsum(sizes).astype("<u8").tobytes())
        file.writelines(chunks)


def _exr_header(height: int, width: int) -> bytes:
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        (b"channels", b"chlist", _EXR_CHANNEL + b"\0" + struct.pack("<iB3x2i", 2, 0, 1, 1) + b"\0"),
        (b"compression", b"compression", b"\x03"),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1)),
        (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0, 0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1)),
    )
    entries = (name + b"\0" + kind + b"\0" + struct.pack("<i", len(data)) + data for name, kind, data in attributes)
    return _EXR + b"".join(entries) + b"\0"


def _exr_chunk(first: int, lines: NDArray[np.float32]) -> bytes:
    """Bytes of even places before those of odd ones, as differences, through zlib; plain if that is not smaller."""
    plain = lines.tobytes()
    places = np.frombuffer(plain, np.uint8)
    sorted_bytes = np.concatenate([places[::2], places[1::2]])
    sorted_bytes[1:] += 128 - sorted_bytes[:-1]
    packed = zlib.compress(sorted_bytes.tobytes(), 6)
    data = packed if len(packed) < len(plain) else plain
    return struct.pack("<2i", first, len(data)) + data


def depth_steps(depth: NDArray) -> NDArray[np.uint16]:
    """Convert metres along the optical axis to units of a depth file; 0 if not finite or out of range."""
    steps = np.where(np.isfinite(depth), np.round(np.nan_to_num(depth, posinf=0) / DEPTH_UNIT), 0)
    return np.where((steps > 0) & (steps < 65536), steps, 0).astype(np.uint16)


def normal_bytes(normal: NDArray, covered: NDArray) -> NDArray[np.uint8]:
    """Convert world normals [H, W, 3] to values of a normal file, 0 outside `covered` [H, W]."""
    values = np.zeros(normal.shape, np.uint8)
    values[covered] = np.round((np.clip(normal[covered], -1, 1) + 1) * 127.5)
    return values
