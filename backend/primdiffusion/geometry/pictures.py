"""Decode untrusted picture files in limited memory.

A picture of one colour compresses to a thousandth, so that a small file may claim as much as a scan's texture of
8192 x 8192 pixels, which is a large file. Hence two limits, both checked before pixels are decoded: MOST_PIXELS for
all, and for what a decoded picture takes, UNBACKED_BYTES or LARGEST_RATIO times the size of its file.
"""

from __future__ import annotations

import contextlib
import os
import struct
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from primdiffusion.files.regular_files import FileError, open_regular

MOST_PIXELS = 8192 * 8192
"""Most pixels of a picture: what scans have."""
UNBACKED_BYTES = 160 * 2**20
"""Bytes that a decoded picture may take however small its file is: colour of 6,400 x 6,400 pixels, grey of any size."""
LARGEST_RATIO = 160
"""Decoded bytes for each byte of the file beyond that. A scan's texture of 8192 x 8192 then needs a file of 1.7 MB; as
JPEG it has 1.0 MB if all of it has one colour."""
LARGEST_FILE = 512 * 2**20
"""Bytes of a picture file."""
_UNREADABLE = (
    SyntaxError, ValueError, TypeError, LookupError, EOFError, OverflowError, RuntimeError, MemoryError, struct.error,
    zlib.error, Image.DecompressionBombError, Image.DecompressionBombWarning,
)  # fmt: skip


@contextlib.contextmanager
def opened_picture(
    source: Path | BinaryIO, formats: tuple[str, ...] = ("PNG", "JPEG"), bytes_each: int = 4
) -> Iterator[Image.Image]:
    """Open a picture of one of Pillow's `formats`; errors of decoding it in the block are ValueErrors too.

    `bytes_each` is the number of bytes that the block makes of a pixel, by which large pictures of small files are
    rejected before anything is decoded.

    Raises ValueError with a reason that does not name the file, FileError for a folder or a file that is too large, and
    OSError for one that cannot be opened.
    """
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(open_regular(source, LARGEST_FILE)) if isinstance(source, Path) else source
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limits below are smaller
                with Image.open(file, formats=formats) as picture:
                    check_pixels(picture.width, picture.height, size, bytes_each)
                    yield picture
        except FileError:
            raise
        except OSError as e:
            if e.errno is not None:
                raise
            raise ValueError(str(e)[:120]) from e
        except _UNREADABLE as e:
            raise ValueError(str(e)[:120]) from e


def check_pixels(width: int, height: int, file_size: int, bytes_each: int) -> None:
    """Raise ValueError for more pixels than MOST_PIXELS, or than a file of this size may have (see the module)."""
    if width * height > MOST_PIXELS:
        raise ValueError(f"{width} x {height} pixels, more than {MOST_PIXELS}")
    if width * height * bytes_each > decoded_bytes(file_size):
        raise ValueError(f"{width} x {height} pixels in a file of only {file_size} bytes")


def decoded_bytes(file_size: int) -> int:
    """The most bytes that what is decoded from a file of this size may take."""
    return max(UNBACKED_BYTES, LARGEST_RATIO * file_size)


def decoded(picture: Image.Image, mode: str) -> UInt8[np.ndarray, "H W *channels"]:
    """Decode a picture to Pillow's `mode` ("RGBA", "RGB", "L")."""
    return np.array(picture if picture.mode == mode else picture.convert(mode))


def is_indexed(picture: Image.Image) -> bool:
    """Whether pixels are indices of a palette with other colours than greys, which masks use for labels."""
    colours = np.array(picture.getpalette() or [0, 0, 0]).reshape(-1, 3) if picture.mode == "P" else np.zeros((1, 3))
    return bool(np.ptp(colours, axis=1).any())


def label_values(picture: Image.Image) -> np.ndarray:
    """The values [H, W] by which a mask marks areas: indices (`is_indexed`), up to 16 bits of grey, or brightness."""
    if picture.mode.startswith("I"):
        return np.asarray(picture).astype(np.uint16)
    return decoded(picture, "P" if is_indexed(picture) else "L")
