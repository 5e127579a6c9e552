"""Images composed of finished captures, which are of one human over black: several humans, and pictures behind them."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from PIL import Image

from primdiffusion.capture.reader import Subject
from primdiffusion.capture.render import JPEG_QUALITY, srgb_bytes
from primdiffusion.formats import capture_layout
from primdiffusion.formats.picture_files import DEPTH_UNIT
from primdiffusion.formats.regular_files import as_file_error, check_inside
from primdiffusion.formats.whole_files import replacing
from primdiffusion.geometry.pictures import opened_picture
from primdiffusion.raster.textures import LINEAR_OF_BYTE

FOLDER = "composed"
"""Folder of composed images, in that of the captures."""


@dataclasses.dataclass(frozen=True)
class Backgrounds:
    """Pictures to draw from for each view."""

    paths: tuple[Path, ...]
    seed: int = 0

    def drawn(self, subject: str, frame: int, camera: int) -> Path:
        """The picture behind a view; the order of views has no influence."""
        return self.paths[capture_layout.view_seed(self.seed, subject, frame, camera) % len(self.paths)]


def composed_path(subject: Subject, frame: int, camera: int) -> Path:
    """Path of a composed image, whose first human is `subject`."""
    root = subject.folder.parent
    return capture_layout.picture_path(root / FOLDER / subject.name, "img", camera, frame)


def write_composed(
    views: Sequence[StoredView], subject: Subject, frame: int, camera: int, background: Path | None
) -> None:
    """Write an image of all humans in a view, of whom `subject` is the first, over a background or black, atomically.

    Raises:
        FileNotFoundError, FileError: an image or the background is missing or damaged.
        FileError, OSError: the file cannot be written, or lies behind a link out of the captures.
    """
    path, view = composed_path(subject, frame, camera), subject.views[camera]
    check_inside(path, subject.folder.parent)
    behind = np.zeros((view.height, view.width, 3), np.uint8)
    if background is not None:
        behind = read_background(background, view.width, view.height)
    with replacing(path) as partial:
        Image.fromarray(compose(views, behind)).save(partial, format="JPEG", quality=JPEG_QUALITY, subsampling=0)


@dataclasses.dataclass(frozen=True, eq=False)
class StoredView:
    """The passes of a human in a view, as stored, and where the human is."""

    img: UInt8[np.ndarray, "H W 3"]
    mask: UInt8[np.ndarray, "H W"]
    depth: UInt16[np.ndarray, "H W"]
    distance: float
    """Depth of the hips, metres, for pixels of the mask without a depth: edges."""


def uncovered(views: Sequence[StoredView]) -> Float32[np.ndarray, "n+1 H W"]:
    """The share of each pixel that nearer humans leave to each human, and, last, to the background."""
    depth = np.stack([np.where(view.depth > 0, view.depth * DEPTH_UNIT, view.distance) for view in views])
    shares = np.stack([1 - view.mask / np.float32(255) for view in views])
    order = depth.argsort(axis=0, kind="stable")
    left = np.cumprod(np.take_along_axis(shares, order, axis=0), axis=0)
    found = np.ones((len(views) + 1, *depth.shape[1:]), np.float32)
    np.put_along_axis(found[:-1], order[1:], left[:-1], axis=0)
    found[-1] = left[-1]
    return found


def compose(views: Sequence[StoredView], background: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw all humans and the background in linear light, nearer over farther; colours are premultiplied over black."""
    layers = [*(view.img for view in views), background]
    shares = uncovered(views)
    linear = sum(share[..., None] * LINEAR_OF_BYTE[layer] for share, layer in zip(shares, layers, strict=True))
    return srgb_bytes(np.minimum(linear, 1))


def read_background(path: Path, width: int, height: int) -> UInt8[np.ndarray, "height width 3"]:
    """Read a PNG, JPEG or WebP: its middle, as large as the proportions allow, resampled to `width` x `height`.

    Raises:
        FileNotFoundError: it does not exist.
        FileError: it is damaged.
    """
    if not os.path.lexists(path):
        raise FileNotFoundError(f"the background {path} does not exist: check the path")
    unusable = as_file_error(path, "is not a picture for backgrounds", "take it out of the folder", OSError)
    with unusable, opened_picture(path, ("PNG", "JPEG", "WEBP")) as picture:
        scale = min(picture.width / width, picture.height / height)
        left, top = (picture.width - scale * width) / 2, (picture.height - scale * height) / 2
        box = (left, top, left + scale * width, top + scale * height)
        return np.asarray(picture.convert("RGB").resize((width, height), Image.Resampling.BICUBIC, box))
