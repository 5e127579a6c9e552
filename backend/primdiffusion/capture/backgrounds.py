"""Pictures behind the humans of finished captures, drawn for each view by seed: captures themselves are over black."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from primdiffusion.capture.reader import Subject
from primdiffusion.capture.render import JPEG_QUALITY, srgb_bytes
from primdiffusion.formats import capture_layout
from primdiffusion.formats.regular_files import FileError
from primdiffusion.formats.removing import check_inside
from primdiffusion.formats.whole_files import replacing
from primdiffusion.geometry.pictures import PictureError, opened_picture
from primdiffusion.raster.textures import LINEAR_OF_BYTE

FOLDER = "composed"
"""Folder of the images with backgrounds, in that of the captures."""


@dataclasses.dataclass(frozen=True)
class Backgrounds:
    """Pictures to draw from."""

    paths: tuple[Path, ...]
    seed: int = 0

    def drawn(self, subject: str, frame: int, camera: int) -> Path:
        """The picture behind a view; the order of views has no influence."""
        return self.paths[capture_layout.view_seed(self.seed, subject, frame, camera) % len(self.paths)]


def composed_path(subject: Subject, frame: int, camera: int) -> Path:
    """Path of a view's image with its background."""
    root = subject.folder.parent
    return capture_layout.picture_path(root / FOLDER / subject.name, "img", camera, frame)


def write_composed(subject: Subject, frame: int, camera: int, background: Path) -> None:
    """Write a view's image over a background, atomically: a JPEG of the same size.

    Raises:
        FileNotFoundError, FileError: an image or the background is missing or damaged.
        OutsideFolderError, OSError: the file cannot be written, or lies behind a link out of the captures.
    """
    path, view = composed_path(subject, frame, camera), subject.views[camera]
    check_inside(path, subject.folder.parent)
    image = compose(subject.rgba(frame, camera), read_background(background, view.width, view.height))
    with replacing(path) as partial:
        Image.fromarray(image).save(partial, format="JPEG", quality=JPEG_QUALITY, subsampling=0)


def compose(rgba: UInt8[np.ndarray, "H W 4"], background: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Add a background in linear light, where the mask leaves it uncovered; colours are premultiplied over black."""
    uncovered = 1 - rgba[..., 3:] / np.float32(255)
    return srgb_bytes(np.minimum(LINEAR_OF_BYTE[rgba[..., :3]] + uncovered * LINEAR_OF_BYTE[background], 1))


def read_background(path: Path, width: int, height: int) -> UInt8[np.ndarray, "height width 3"]:
    """Read a PNG, JPEG or WebP: its middle, as large as the proportions allow, resampled to `width` x `height`.

    Raises:
        FileNotFoundError: it does not exist.
        FileError: it is damaged.
    """
    try:
        with opened_picture(path, ("PNG", "JPEG", "WEBP")) as picture:
            scale = min(picture.width / width, picture.height / height)
            left, top = (picture.width - scale * width) / 2, (picture.height - scale * height) / 2
            box = (left, top, left + scale * width, top + scale * height)
            return np.asarray(picture.convert("RGB").resize((width, height), Image.Resampling.BICUBIC, box))
    except FileNotFoundError:
        raise FileNotFoundError(f"the background {path} does not exist: check the path") from None
    except (OSError, PictureError) as e:
        raise FileError(path, f"is not a picture for backgrounds ({e!s:.160})", "take it out of the folder") from e
