"""Plain pictures of one person: what is cut out of them for reconstruction, and what is wrong with others.

A picture shows who is meant by its alpha, or by a mask file: opaque where the person is, or white if it has no alpha;
or of the person's label, if that is named. The orientation that cameras write into EXIF is applied to both, each by its
own. Only the square around the person is kept, scaled down.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image, ImageOps
from scipy import ndimage

from primdiffusion.capture.reader import Window, resample
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats.camera_rig import View
from primdiffusion.geometry.pictures import decoded, label_values, opened_picture
from primdiffusion.raster.textures import BYTE_OF_LINEAR, LINEAR_OF_BYTE

LARGEST_SIDE = 512
"""Sides of what is kept of a picture, pixels; larger ones are scaled down."""
SMALLEST_FIGURE = 32
"""Height of a person, pixels, from which a pose can be estimated."""
SECOND_FIGURE = 0.2
"""Share of the largest component's area from which another is a second person."""
SMALLEST_PART = 0.01
"""Share below which a component is a fault of the mask; those between are parts of the person behind something."""
MASK_SIDE = 512
"""Largest side of the mask in which components are counted."""
MARGIN = 0.08
"""Empty border around the person, as a share of the longer side of its box."""
LONG_SIDE_DEGREES = 45.0
"""Field of view along the longer side where a picture does not state its lens: a lens of 43 mm on 35 mm film."""
FILM_MM = 36.0
_EXIF, _FOCAL_35_MM = ExifTags.IFD.Exif, ExifTags.Base.FocalLengthIn35mmFilm


@dataclasses.dataclass(frozen=True, eq=False)
class Photograph:
    """The person in a picture."""

    path: Path
    rgba: UInt8[np.ndarray, "h w 4"]
    """The square around the person: sRGB over black, and the mask."""
    window: Window
    """The square in the upright picture; it may reach beyond."""
    width: int
    """Width and height of the upright picture, pixels."""
    height: int
    focal: float | None
    """Focal length in pixels of the upright picture, if it states its lens."""
    uncut: UInt8[np.ndarray, "h w 4"] | None = None
    """The square, opaque, of a picture without a mask, whose person is cut out by the outline of a body."""

    def with_mask(self, mask: UInt8[np.ndarray, "h w"]) -> Photograph:
        """The person of an uncut picture in another mask."""
        assert self.uncut is not None
        return dataclasses.replace(self, rgba=_over_black(self.uncut, np.minimum(mask, self.uncut[..., 3])))

    def whole_mask(self) -> UInt8[np.ndarray, "H W"]:
        """The mask in the upright picture."""
        window, scale = self.window, len(self.rgba) / self.window.width
        place = (scale, 0, -scale * window.left, 0, scale, -scale * window.top)  # not by whole pixels
        square, size = Image.fromarray(self.rgba[..., 3]), (self.width, self.height)
        return np.asarray(square.transform(size, Image.Transform.AFFINE, place, Image.Resampling.BILINEAR))

    def lens(self) -> View:
        """A level camera at the origin that sees the upright picture: the stated lens, or LONG_SIDE_DEGREES."""
        focal = self.focal
        if focal is None:
            focal = max(self.width, self.height) / (2 * math.tan(math.radians(LONG_SIDE_DEGREES) / 2))
        intrinsics = np.array([[focal, 0, self.width / 2], [0, focal, self.height / 2], [0, 0, 1]])
        return View(intrinsics, np.diag([1.0, -1.0, -1.0]), np.zeros(3), self.width, self.height)


def read_photographs(
    pictures: Sequence[Path],
    masks: Sequence[Path] = (),
    side: int = LARGEST_SIDE,
    mask_label: int | None = None,
    outline: Callable[[int, int], UInt8[np.ndarray, "H W"]] | None = None,
) -> list[Photograph]:
    """Read pictures of one person, with a mask file for each or with alpha; squares of the same side.

    `outline` draws a body over an opaque picture without a mask file, of a width and height in pixels; it stands for
    the mask of such a picture, which is kept `uncut`. `mask_label` is the person's in masks of labels: the index in the
    palette, or else the grey value.

    Raises:
        ValueError: there are not as many masks as pictures.
        FileNotFoundError: a file is missing.
        FileError: a file is not a PNG or JPEG, is damaged or too large, or shows no person, or more than one person.
    """
    if masks and len(masks) != len(pictures):
        raise ValueError(f"there are {len(masks)} masks for {len(pictures)} pictures: give one for each, or none")
    pairs = zip(pictures, masks or [None] * len(pictures), strict=True)
    found = [_figure(path, mask, mask_label, outline) for path, mask in pairs]
    side = min(side, max(math.ceil(figure.window.width) for figure in found))
    return [_scaled(figure, side) for figure in found]


def _scaled(figure: Photograph, side: int) -> Photograph:
    """The square of a figure, of which there is the part within the picture, from the nearest whole pixels on."""
    window = figure.window
    left, top = max(math.floor(window.left), 0), max(math.floor(window.top), 0)
    inside = dataclasses.replace(window, left=window.left - left, top=window.top - top)
    uncut = None if figure.uncut is None else resample(figure.uncut, inside, side)
    return dataclasses.replace(figure, rgba=resample(figure.rgba, inside, side), uncut=uncut)


def _figure(
    path: Path,
    mask_path: Path | None,
    mask_label: int | None,
    outline: Callable[[int, int], UInt8[np.ndarray, "H W"]] | None,
) -> Photograph:
    """A person before it is scaled."""
    with _picture(path) as picture:
        focal, bands = _focal_length(picture), picture.getbands()
        pixels = decoded(ImageOps.exif_transpose(picture), "RGBA")
    uncut = mask_path is None and outline is not None and pixels[..., 3].min() == 255
    if uncut and outline is not None:
        mask = outline(pixels.shape[1], pixels.shape[0])
    elif mask_path is None:
        mask = pixels[..., 3]
        if "A" not in bands and mask.min() == 255:
            raise FileError(
                path,
                "does not tell who is meant",
                "give a picture with alpha, a mask file, or a body posed over it (a posture.json with its camera)",
            )
        if mask.min() == 255:
            raise FileError(path, "is opaque everywhere", "cut the person out, or give a mask file for it")
    else:
        with _picture(mask_path) as picture:
            mask = _coverage(ImageOps.exif_transpose(picture), mask_label)
        if mask.shape != pixels.shape[:2]:
            size = f"{mask.shape[1]} x {mask.shape[0]} pixels"
            raise FileError(
                mask_path, f"has {size}, its picture {pixels.shape[1]} x {pixels.shape[0]}", "make it as large"
            )
    named = path if mask_path is None else mask_path
    box, keep = _person_box(named, mask)
    window = _around(box)
    height, width = mask.shape
    rows = slice(max(math.floor(window.top), 0), min(math.ceil(window.top + window.height), height))
    columns = slice(max(math.floor(window.left), 0), min(math.ceil(window.left + window.width), width))
    rgba = _over_black(pixels[rows, columns], (mask * keep if keep.shape == mask.shape else mask)[rows, columns])
    focal = focal and focal * max(width, height)
    return Photograph(path, rgba, window, width, height, focal, pixels[rows, columns] if uncut else None)


@contextlib.contextmanager
def _picture(path: Path) -> Iterator[Image.Image]:
    """Open a picture; errors are sentences that name it."""
    try:
        with opened_picture(path) as picture:
            yield picture
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no picture {path}: check the path") from None
    except FileError:
        raise
    except (OSError, ValueError) as e:
        raise FileError(path, f"is not a PNG or JPEG that can be read ({e!s:.160})", "save it again, or smaller") from e


def _focal_length(picture: Image.Image) -> float | None:
    """Focal length in longer sides of the picture, from that on 35 mm film; None if not stated."""
    try:
        stated = float(picture.getexif().get_ifd(_EXIF).get(_FOCAL_35_MM) or 0)
    except (TypeError, ValueError, ArithmeticError, LookupError, SyntaxError):
        return None
    return stated / FILM_MM if 5 <= stated <= 1000 else None


def _coverage(picture: Image.Image, label: int | None) -> UInt8[np.ndarray, "H W"]:
    """255 where the person is in a mask file, less at soft edges: of `label`, else by alpha if some of it is not
    opaque, else by brightness."""
    if label is not None:
        return np.where(label_values(picture) == label, np.uint8(255), np.uint8(0))
    if picture.has_transparency_data:
        alpha = decoded(picture, "LA")[..., 1]
        if alpha.min() < 255:
            return alpha
    if picture.mode.startswith("I"):
        return (label_values(picture) // 257).astype(np.uint8)
    return decoded(picture, "L")


def _person_box(path: Path, mask: UInt8[np.ndarray, "H W"]) -> tuple[tuple[int, int, int, int], np.ndarray]:
    """Left, top, right, bottom of the person in the mask, and the mask's factor 0 or 1 [H, W] or [1, 1]."""
    block = math.ceil(max(mask.shape) / MASK_SIDE)
    small = mask[::block, ::block] > 127
    labels = np.empty(small.shape, np.int32)
    ndimage.label(small, np.ones((3, 3)), output=labels)
    count = int(labels.max())
    if not count:
        raise FileError(path, "shows no person: no pixel is half covered", "mark the person white, or name a label")
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    largest = areas.max()
    figures = _count_figures(labels, 1 + np.flatnonzero(areas >= SECOND_FIGURE * largest), 1 + int(areas.argmax()))
    if figures > 1:
        raise FileError(path, f"shows {figures} separate figures", "leave one person in the mask")
    person = np.isin(labels, 1 + np.flatnonzero(areas >= SMALLEST_PART * largest))
    keep: np.ndarray = np.ones((1, 1), np.uint8)
    if (areas < SMALLEST_PART * largest).any():
        grown = ndimage.binary_dilation(person, iterations=2)
        keep = np.kron(grown, np.ones((block, block), np.uint8))[: mask.shape[0], : mask.shape[1]].astype(np.uint8)
    rows, columns = np.flatnonzero(person.any(axis=1)), np.flatnonzero(person.any(axis=0))
    top, left = rows[0] * block, columns[0] * block
    bottom, right = min((rows[-1] + 1) * block, mask.shape[0]), min((columns[-1] + 1) * block, mask.shape[1])
    if bottom - top < SMALLEST_FIGURE:
        tall = f"is {bottom - top} pixels tall in a picture of {mask.shape[1]} x {mask.shape[0]}"
        raise FileError(path, f"shows too little: the person {tall}", f"at least {SMALLEST_FIGURE} are needed")
    return (int(left), int(top), int(right), int(bottom)), keep


def _count_figures(labels: np.ndarray, large: np.ndarray, largest: int) -> int:
    """1, and the large components that are beside the largest; those above or below it are the same person, behind
    something.
    """
    columns = (labels == largest).any(axis=0)
    shared = [columns[(labels == label).any(axis=0)].mean() for label in large]
    return 1 + sum(share < 0.5 for share in shared)


def _around(box: tuple[int, int, int, int]) -> Window:
    """The square around a box with a margin."""
    left, top, right, bottom = box
    side = (1 + 2 * MARGIN) * max(right - left, bottom - top)
    return Window((left + right - side) / 2, (top + bottom - side) / 2, side, side)


def _over_black(pixels: np.ndarray, mask: np.ndarray) -> UInt8[np.ndarray, "h w 4"]:
    """Colours multiplied by the mask in linear light, row by row, which takes little memory."""
    out = np.empty((*mask.shape, 4), np.uint8)
    for row, colours, share in zip(out, pixels, mask, strict=True):
        linear = LINEAR_OF_BYTE[colours[:, :3]] * (share[:, None] * np.float32(65535 / 255))
        row[:, :3] = BYTE_OF_LINEAR[(linear + np.float32(0.5)).astype(np.int64)]
        row[:, 3] = share
    return out
