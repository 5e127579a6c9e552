"""Uncompressed OpenEXR files as Blender writes them, read with numpy: not every Blender comes with OpenImageIO."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_MAGIC, _MULTIPART = 20000630, 0x1000
_DTYPES = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}


class ExrError(ValueError):
    """A file that is no uncompressed OpenEXR of scan lines, or not whole."""


@dataclasses.dataclass(frozen=True)
class _Part:
    channels: tuple[tuple[str, np.dtype], ...]
    width: int
    height: int


def read_exr(path: Path) -> dict[str, NDArray[np.float32]]:
    """All channels by name, [H, W] float32, top row first; those of a part called `ViewLayer.Depth` too.

    Names are as Blender gives them: "ViewLayer.Combined.R". Raises ExrError.
    """
    data = path.read_bytes()
    try:
        return _read(data)
    except (struct.error, IndexError, ValueError, KeyError) as error:
        raise ExrError(f"{path} is no whole, uncompressed OpenEXR picture ({error}): render it again") from error


def _read(data: bytes) -> dict[str, NDArray[np.float32]]:
    magic, version = struct.unpack_from("<ii", data, 0)
    if magic != _MAGIC:
        raise ValueError("it does not begin as one")
    multipart = bool(version & _MULTIPART)
    parts, at = [], 8
    while True:
        attributes, at = _header(data, at)
        parts.append(_part(attributes))
        if not multipart:
            break
        if data[at] == 0:
            at += 1
            break
    planes: dict[str, NDArray[np.float32]] = {}
    for part in parts:
        offsets = struct.unpack_from(f"<{part.height}Q", data, at)
        at += 8 * part.height
        planes |= _planes(data, part, [offset + 4 * multipart for offset in offsets])
    return planes


def _header(data: bytes, at: int) -> tuple[dict[str, bytes], int]:
    attributes = {}
    while data[at]:
        name, at = _text(data, at)
        _kind, at = _text(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        attributes[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    return attributes, at + 1


def _part(attributes: dict[str, bytes]) -> _Part:
    if attributes["compression"][0] != 0:
        raise ValueError("it is compressed")
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    return _Part(tuple(_channels(attributes["channels"])), right - left + 1, bottom - top + 1)


def _channels(data: bytes) -> Iterator[tuple[str, np.dtype]]:
    at = 0
    while data[at]:
        name, at = _text(data, at)
        (kind,) = struct.unpack_from("<i", data, at)
        yield name, _DTYPES[kind]
        at += 16


def _planes(data: bytes, part: _Part, offsets: list[int]) -> dict[str, NDArray[np.float32]]:
    """Each line is its y, its size in bytes, then its channels one after the other."""
    row = np.dtype([(f"c{i}", dtype, part.width) for i, (_, dtype) in enumerate(part.channels)])
    lines = np.empty(part.height, row)
    (first,) = struct.unpack_from("<i", data, offsets[0])
    top = min(first, struct.unpack_from("<i", data, offsets[-1])[0])
    for offset in offsets:
        y, size = struct.unpack_from("<ii", data, offset)
        if size != row.itemsize:
            raise ValueError(f"a line of {size} bytes instead of {row.itemsize}")
        lines[y - top] = np.frombuffer(data, row, 1, offset + 8)[0]
    return {name: lines[f"c{i}"].astype(np.float32) for i, (name, _) in enumerate(part.channels)}


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(0, at)
    return data[at:end].decode(), end + 1
