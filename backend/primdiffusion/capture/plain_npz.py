"""Reading .npz files that others made: plain arrays, of sane size; never a pickle, never a path out of the file.

The extension, which imports nothing of the backend, has `motion/arrays.py` for the same.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 1 << 30
"""Of one array, unpacked. Small files can claim to hold petabytes."""


class NpzError(ValueError):
    """A file that is no .npz of plain arrays, or lacks one."""


def read_npz(path: str | Path, wanted: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray]:
    """The arrays `wanted`, and those of `optional` that are there.

    Raises:
        FileNotFoundError: there is no such file.
        NpzError: it is no whole .npz, lacks a wanted array, or one is pickled, too large, or holds no finite numbers.
    """
    present = {}
    for name in (*wanted, *optional):
        data = read_member(path, f"{name}.npy", required=name in wanted)
        if data is not None:
            present[name] = _numbers(path, name, data)
    return present


def read_member(path: str | Path, member: str, *, required: bool = True) -> bytes | None:
    """The bytes of one file in a zip archive; nothing is unpacked to disk.

    Raises:
        FileNotFoundError: there is no such archive.
        NpzError: it is no whole archive, or lacks the member, or it is too large.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            try:
                about = archive.getinfo(member)
            except KeyError:
                if required:
                    raise NpzError(f"{path} holds no array {member.removesuffix('.npy')!r}: make it again") from None
                return None
            if about.file_size > MOST_BYTES:
                raise NpzError(f"{path}: {member} claims {about.file_size} bytes, which is too much: make it again")
            return archive.read(about)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as e:
        raise NpzError(f"{path} is no whole .npz file ({e}): make it again") from e


def _numbers(path: str | Path, name: str, data: bytes) -> NDArray:
    try:
        values = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, MemoryError, OverflowError, SyntaxError) as e:
        raise NpzError(f"{path}: {name!r} is no plain array ({e}): save it as numbers") from e
    if values.dtype.kind not in "biuf":
        raise NpzError(f"{path}: {name!r} holds {values.dtype}, not numbers: save it as numbers")
    if not np.isfinite(values).all():
        raise NpzError(f"{path}: {name!r} holds NaN or infinite numbers: make it again")
    return values
