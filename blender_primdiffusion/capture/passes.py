"""From Cycles' render of a view (an uncompressed OpenEXR, read with numpy) to the pictures of its passes."""

from __future__ import annotations

import dataclasses
import errno
import struct
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.capture_layout import picture_path
from ..formats.picture_files import depth_steps, is_whole_picture, normal_bytes, write_exr, write_png
from ..formats.regular_files import FileError, as_file_error, read_regular
from ..formats.whole_files import replacing
from ..scene.convention import points_to_backend
from .surfaces import PART

_LARGEST_FILE = 2**32
_MAGIC, _MULTIPART = 20000630, 0x1000
_DTYPES = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}


@dataclasses.dataclass(frozen=True)
class _Part:
    channels: tuple[tuple[str, np.dtype], ...]
    width: int
    height: int


def read_exr(path: Path) -> dict[str, NDArray[np.float32]]:
    """All channels by name, [H, W] float32, top row first; those of a part called `ViewLayer.Depth` too.

    Names are as Blender gives them: "ViewLayer.Combined.R". Raises FileError.
    """
    data = read_regular(path, _LARGEST_FILE)
    with as_file_error(path, "is not a whole, uncompressed OpenEXR picture", "render it again", struct.error):
        return _read(data)


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
        if size < 0:  # which would lead back
            raise ValueError(f"an attribute of {size} bytes")
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
    row = np.dtype([(f"c{i}", dtype, (part.width,)) for i, (_, dtype) in enumerate(part.channels)])
    if part.height * row.itemsize > len(data):
        raise ValueError(f"it is cut short: {part.height} lines of {row.itemsize} bytes are announced")
    lines, seen = np.empty(part.height, row), np.zeros(part.height, bool)
    (first,) = struct.unpack_from("<i", data, offsets[0])
    top = min(first, struct.unpack_from("<i", data, offsets[-1])[0])
    for offset in offsets:
        y, size = struct.unpack_from("<ii", data, offset)
        if size != row.itemsize:
            raise ValueError(f"a line of {size} bytes instead of {row.itemsize}")
        if not 0 <= y - top < part.height or seen[y - top]:
            raise ValueError(f"line {y} twice, or outside of the picture")
        lines[y - top], seen[y - top] = np.frombuffer(data, row, 1, offset + 8)[0], True
    return {name: lines[f"c{i}"].astype(np.float32) for i, (name, _) in enumerate(part.channels)}


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(0, at)
    return data[at:end].decode(), end + 1


JPEG_QUALITY = 95
_ENVIRONMENT = ("Environment", "Env")
"""The pass's name in Blender 5 and before."""
_NOTHING_M = 1e9
"""Cycles gives rays that hit nothing a depth of 1e10."""


@dataclasses.dataclass(frozen=True, eq=False)
class Colours:
    """What fills the pixels, averaged over each."""

    rgb: NDArray[np.float32]
    """Linear, premultiplied [H, W, 3]."""
    alpha: NDArray[np.float32]
    """Share of the pixel that is covered [H, W]."""
    environment: NDArray[np.float32] | None = None
    """What the rest of the pixel shows of the HDRI [H, W, 3], linear; None if it was not rendered."""


@dataclasses.dataclass(frozen=True, eq=False)
class Centres:
    """What the rays through the pixels' centres hit."""

    depth: NDArray[np.float32]
    """Metres along the optical axis [H, W]; inf where nothing is."""
    normal: NDArray[np.float64]
    """World, backend's axes [H, W, 3]."""
    part: NDArray[np.uint8]
    """1 + joint [H, W]; 0 where nothing is."""


def read_colours(path: Path) -> Colours:
    """The combined pass of a multilayer EXR; with denoising only its colours are denoised, not its alpha."""
    planes = read_exr(path)
    red, green, blue, alpha = _chosen(path, planes, [f"Combined.{channel}" for channel in "RGBA"])
    name = next((name for name in _ENVIRONMENT if any(plane.endswith(f".{name}.R") for plane in planes)), None)
    behind = None if name is None else np.stack(_chosen(path, planes, [f"{name}.{channel}" for channel in "RGB"]), -1)
    return Colours(np.stack([red, green, blue], -1), alpha, behind)


def read_centres(path: Path) -> Centres:
    """The passes of a multilayer EXR that was rendered through the pixels' centres."""
    depth, x, y, z, part = _chosen(path, read_exr(path), ["Depth.Z", "Normal.X", "Normal.Y", "Normal.Z", f"{PART}.X"])
    depth = np.where(depth < _NOTHING_M, depth, np.float32(np.inf))
    normal = points_to_backend(np.stack([x, y, z], -1))
    part = np.where(np.isfinite(depth), np.round(part), 0)  # behind a hole it is the hole's
    return Centres(depth, normal, part.clip(0, 24).astype(np.uint8))


def write_passes(
    subject: Path,
    kinds: tuple[str, ...],
    where: tuple[int, int],
    colours: Colours | None,
    centres: Centres | None,
) -> None:
    """The pictures of one view in the order of `kinds`; `where` is (frame, camera)."""
    frame, camera = where
    for kind in kinds:
        path = picture_path(subject, kind, camera, frame)
        if kind == "img":
            _write_jpeg(path, srgb_bytes(colours.rgb))
        elif kind == "hdri":
            _write_jpeg(path, srgb_bytes(colours.rgb + colours.environment))
        elif kind == "rgba":
            alpha = np.clip(colours.alpha, 0, 1)[..., None]
            straight = srgb_bytes(colours.rgb / np.where(alpha > 0, alpha, 1))
            write_png(path, np.concatenate([straight, _bytes(alpha)], -1))
        elif kind == "mask":
            write_png(path, _bytes(colours.alpha))
        elif kind == "depth_float":
            write_exr(path, np.where(np.isfinite(centres.depth), centres.depth, 0))
        elif kind == "depth":
            write_png(path, depth_steps(centres.depth))
        elif kind == "normal":
            write_png(path, normal_bytes(centres.normal, np.isfinite(centres.depth)))
        else:
            write_png(path, centres.part)


def srgb_bytes(linear: NDArray) -> NDArray[np.uint8]:
    """Linear colours as sRGB bytes, as Blender's view transform Standard has them (IEC 61966-2-1)."""
    linear = np.clip(linear, 0, 1)
    return _bytes(np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055))


def _bytes(values: NDArray) -> NDArray[np.uint8]:
    return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)


def _write_jpeg(path: Path, pixels: NDArray[np.uint8]) -> None:
    height, width = pixels.shape[:2]
    values = np.ones((height, width, 4), np.float32)
    values[..., :3] = pixels[::-1] / np.float32(255)
    sheet = bpy.data.images.new(path.stem, width, height, alpha=False)
    try:
        sheet.pixels.foreach_set(values.ravel())
        sheet.file_format = "JPEG"
        with replacing(path) as partial:
            sheet.save(filepath=str(partial), quality=JPEG_QUALITY)
            if not is_whole_picture(partial):  # on a full disk Blender saves what fits, and says nothing
                raise OSError(errno.ENOSPC, "there is no room to write", str(path))
    except RuntimeError as error:
        raise OSError(f"{path} cannot be written ({error!s:.160}): is the disk full?") from error
    finally:
        bpy.data.images.remove(sheet)


def _chosen(path: Path, planes: dict[str, NDArray], endings: list[str]) -> list[NDArray[np.float32]]:
    """Planes by the ends of their names, of one size and without NaN: that is 0. Raises FileError."""
    found = [next((plane for name, plane in planes.items() if name.endswith(f".{ending}")), None) for ending in endings]
    shapes = {plane.shape for plane in found if plane is not None}
    missing = [ending for ending, plane in zip(endings, found, strict=True) if plane is None]
    if missing or len(shapes) != 1:
        what = f"holds no pass {missing[0]}" if missing else "holds passes of several sizes"
        raise FileError(path, what, "render it again")
    return [np.nan_to_num(plane, nan=0.0, posinf=np.inf, neginf=-np.inf) for plane in found if plane is not None]
