"""Decode untrusted picture files of a limited size."""

from __future__ import annotations

import contextlib
import struct
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from PIL import Image

from primdiffusion.formats.regular_files import check_regular

MOST_PIXELS = 8192 * 8192
"""Of a picture: small files can claim gigabytes."""
_UNREADABLE = (
    SyntaxError, ValueError, TypeError, LookupError, EOFError, OverflowError, RuntimeError, MemoryError, struct.error,
    zlib.error, Image.DecompressionBombError, Image.DecompressionBombWarning,
)  # fmt: skip


class PictureError(ValueError):
    """A picture that cannot be decoded. The message is a reason without the file's name."""


@contextlib.contextmanager
def opened_picture(source: Path | BinaryIO, formats: tuple[str, ...] = ("PNG", "JPEG")) -> Iterator[Image.Image]:
    """Open a picture of one of Pillow's `formats`; errors of decoding it in the block are PictureErrors too.

    Raises PictureError, and OSError for a file that cannot be opened.
    """
    if isinstance(source, Path):
        check_regular(source)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit below is smaller
            with Image.open(source, formats=formats) as picture:
                if picture.width * picture.height > MOST_PIXELS:
                    raise PictureError(f"{picture.width} x {picture.height} pixels, more than {MOST_PIXELS}")
                yield picture
    except PictureError:
        raise
    except OSError as e:
        if e.errno is not None:
            raise
        raise PictureError(str(e)[:120]) from e
    except _UNREADABLE as e:
        raise PictureError(str(e)[:120]) from e
