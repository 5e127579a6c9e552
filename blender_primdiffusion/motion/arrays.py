"""Plain arrays out of .npz and .npy files of unknown origin: no pickles, no arrays larger than their file says."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

LARGEST_BYTES = 512 * 2**20
"""An array that unpacks to more is refused: an hour of motion with hands at 60 frames a second takes 285 MB."""


class ArrayFileError(ValueError):
    """A file of arrays that cannot be read; one sentence that names the file."""


def array_names(path: Path) -> list[str]:
    """Names of the arrays in an .npz. Raises ArrayFileError where it is no whole zip archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except (zipfile.BadZipFile, OSError) as e:
        raise ArrayFileError(f"{path} is not a whole .npz file ({e}): copy or export it again") from e


def read_npz(path: Path, names: Iterable[str]) -> dict[str, NDArray]:
    """Those of the arrays `names` that an .npz holds; others are never unpacked.

    Raises ArrayFileError where the file is damaged, an array holds Python objects, or one is larger than
    `LARGEST_BYTES`. Nothing is written to disk, so names with paths in them do no harm.
    """
    present = set(array_names(path))
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        for name in names:
            if name not in present:
                continue
            member = archive.getinfo(f"{name}.npy" if f"{name}.npy" in archive.NameToInfo else name)
            try:
                with archive.open(member) as stream:
                    arrays[name] = _read(stream, member.file_size, f"{path}: {name!r}")
            except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError) as e:
                raise ArrayFileError(f"{path}: {name!r} is damaged ({e}): copy or export the file again") from e
    return arrays


def read_npy(path: Path) -> NDArray:
    """The array of an .npy file. Raises ArrayFileError as `read_npz` does."""
    try:
        with path.open("rb") as stream:
            return _read(stream, path.stat().st_size, str(path))
    except OSError as e:
        raise ArrayFileError(f"{path} cannot be read ({e})") from e


def _read(stream: IO[bytes], size: int, what: str) -> NDArray:
    """One array of `size` bytes with its header, which is believed only where it agrees with that size."""
    if size > LARGEST_BYTES:
        raise ArrayFileError(f"{what} unpacks to {size / 2**20:.0f} MB, more than {LARGEST_BYTES // 2**20}: cut it")
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran, dtype = read_header(stream)
    except (ValueError, KeyError) as e:
        raise ArrayFileError(f"{what} is not an array of numpy's format: save it with numpy.save or savez") from e
    if dtype.hasobject:
        raise ArrayFileError(f"{what} holds pickled Python objects, which are never read: save it as plain arrays")
    wanted = math.prod(shape) * dtype.itemsize
    if wanted > size:
        raise ArrayFileError(f"{what} is cut short: its header promises {wanted} bytes, {size} are there")
    data = stream.read(wanted)
    if len(data) < wanted:
        raise ArrayFileError(f"{what} is cut short: its header promises {wanted} bytes, {len(data)} are there")
    array = np.frombuffer(data, dtype)
    return (array.reshape(shape[::-1]).T if fortran else array.reshape(shape)).copy()
