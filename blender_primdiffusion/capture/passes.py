"""From Cycles' render of a view (an OpenEXR) to the pictures of its passes."""

from __future__ import annotations

import dataclasses
import errno
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.picture_files import depth_steps, normal_bytes, write_exr, write_png
from ..files.regular_files import FileError, as_file_error, check_regular
from ..files.whole_files import atomic_replace
from ..formats.capture_layout import picture_path
from ..scene.convention import points_to_backend
from .surfaces import PART

bpy.utils.expose_bundled_modules()
import OpenImageIO  # noqa: E402  Blender's own, importable only after the line above

JPEG_QUALITY = 95
_JPEG_END = b"\xff\xd9"
_ENVIRONMENT = "Environment"
_NOTHING_M = 1e9
"""Cycles gives rays that hit nothing a depth of 1e10."""


def read_exr(path: Path) -> dict[str, NDArray[np.float32]]:
    """All channels by name, [H, W] float32, top row first; those of a part called `ViewLayer.Depth` too.

    Names are as Blender gives them: "ViewLayer.Combined.R". Raises OSError and FileError.
    """
    check_regular(path)
    planes: dict[str, NDArray[np.float32]] = {}
    with as_file_error(path, "is not a whole OpenEXR picture", "render it again"):
        file = OpenImageIO.ImageInput.open(str(path))
        if file is None:
            raise ValueError(OpenImageIO.geterror())
        part = 0
        while file.seek_subimage(part, 0):
            pixels = file.read_image("float")
            if pixels is None:
                raise ValueError(file.geterror())
            planes |= dict(zip(file.spec().channelnames, np.moveaxis(pixels, -1, 0), strict=True))
            part += 1
    return planes


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
    behind = None
    if any(name.endswith(f".{_ENVIRONMENT}.R") for name in planes):
        behind = np.stack(_chosen(path, planes, [f"{_ENVIRONMENT}.{channel}" for channel in "RGB"]), -1)
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
        with atomic_replace(path) as partial:
            sheet.save(filepath=str(partial), quality=JPEG_QUALITY)
            if partial.read_bytes()[-2:] != _JPEG_END:  # on a full disk Blender saves what fits, and says nothing
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
