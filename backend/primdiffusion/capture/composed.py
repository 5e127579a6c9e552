"""Images of several humans, composed of finished captures, which are of one human over black."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numba
import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from PIL import Image

from primdiffusion.capture.reader import Subject
from primdiffusion.capture.render import JPEG_QUALITY
from primdiffusion.files.picture_files import DEPTH_UNIT
from primdiffusion.files.whole_files import replacing
from primdiffusion.formats import capture_layout
from primdiffusion.raster.textures import BYTE_OF_LINEAR, BYTE_STEPS, LINEAR_OF_BYTE

FOLDER = "composed"
"""Folder of composed images, in that of the captures."""


def composed_path(subject: Subject, frame: int, camera: int) -> Path:
    """Path of a composed image, whose first human is `subject`."""
    root = subject.folder.parent
    return capture_layout.picture_path(root / FOLDER / subject.name, "img", camera, frame)


def write_composed(
    images: Sequence[UInt8[np.ndarray, "h w 3"]],
    shares: Float32[np.ndarray, "n h w"],
    box: Box,
    subject: Subject,
    frame: int,
    camera: int,
) -> None:
    """Write an image of all humans in a view, of whom `subject` is the first, over black, atomically.

    `images` and their `uncovered` shares are of the box alone. Raises FileError, OSError where the file cannot be
    written, or lies behind a link out of the captures.
    """
    path, view = composed_path(subject, frame, camera), subject.views[camera]
    image = np.zeros((view.height, view.width, 3), np.uint8)
    image[box] = compose(images, shares)
    with replacing(path, subject.folder.parent) as partial:
        Image.fromarray(image).save(partial, format="JPEG", quality=JPEG_QUALITY, subsampling=0)


Box = tuple[slice, slice]
"""Rows and columns of a picture."""


def drawn_box(pictures: Sequence[UInt8[np.ndarray, "H W ..."]]) -> Box:
    """The smallest box around all pixels of images and masks that are not 0: there are no humans outside of it."""
    rows = _extent([picture.reshape(len(picture), -1).max(1) for picture in pictures])
    highest = [picture[rows].max(0, initial=0) for picture in pictures]
    return rows, _extent([of_column.reshape(len(of_column), -1).max(1) for of_column in highest])


def _extent(values: Sequence[UInt8[np.ndarray, "n"]]) -> slice:
    """From the first to the last place at which one of the values is not 0."""
    (places,) = np.nonzero(np.max(values, axis=0))
    return slice(places[0], places[-1] + 1) if len(places) else slice(0)


def uncovered(
    masks: Sequence[UInt8[np.ndarray, "H W"]], depths: Sequence[UInt16[np.ndarray, "H W"]], distances: Sequence[float]
) -> Float32[np.ndarray, "n H W"]:
    """The share of each pixel that nearer humans leave to each human.

    `distances` are the depths of the hips, metres, for pixels of a mask without a depth: edges.
    """
    shares = np.ones((len(masks), *masks[0].shape), np.float32)
    _uncovered(np.stack(masks), np.stack(depths), np.array(distances), _LEFT_BY_BYTE, shares)
    return shares


def compose(
    images: Sequence[UInt8[np.ndarray, "H W 3"]], shares: Float32[np.ndarray, "n H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw all humans in linear light, nearer over farther; colours are premultiplied over black.

    `shares` are those of `uncovered`.
    """
    image = np.empty_like(images[0], order="C")
    _compose(np.stack(images), shares, LINEAR_OF_BYTE, BYTE_OF_LINEAR, image)
    return image


_LEFT_BY_BYTE = 1 - np.arange(256, dtype=np.uint8) / np.float32(255)
"""The share of a pixel that a human leaves, by the byte of the mask."""


@numba.njit(cache=True, nogil=True)
def _uncovered(masks, depths, distances, left_by_byte, shares):
    """Write shares where they are not 1."""
    humans, height, width = masks.shape
    place, order = np.empty(humans), np.empty(humans, np.int64)
    for row in range(height):
        for column in range(width):
            covered = False
            for human in range(humans):
                covered |= masks[human, row, column] > 0
            if not covered:
                continue
            for human in range(humans):
                steps = depths[human, row, column]
                place[human] = steps * DEPTH_UNIT if steps > 0 else distances[human]
                at = human
                while at > 0 and place[order[at - 1]] > place[human]:
                    order[at] = order[at - 1]
                    at -= 1
                order[at] = human
            left = np.float32(1)
            for human in order:
                shares[human, row, column] = left
                left *= left_by_byte[masks[human, row, column]]


@numba.njit(cache=True, nogil=True)
def _compose(layers, shares, linear_of_byte, byte_of_linear, image):
    count, height, width, _ = layers.shape
    for row in range(height):
        for column in range(width):
            for channel in range(3):
                total = np.float32(0)
                for layer in range(count):
                    total += shares[layer, row, column] * linear_of_byte[layers[layer, row, column, channel]]
                image[row, column, channel] = byte_of_linear[
                    int(min(total, np.float32(1)) * np.float32(BYTE_STEPS - 1) + np.float32(0.5))
                ]
