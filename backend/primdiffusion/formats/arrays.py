"""Read untrusted .npz and .npy files: no pickles, no arrays larger than their file, no extraction to disk."""

from __future__ import annotations

import contextlib
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

LARGEST_BYTES = 512 * 2**20
"""Largest size of an array: small files can claim petabytes. An hour of motion at 60 frames/s takes 285 MB."""


class ArrayFileError(ValueError):
    """A file of arrays that cannot be read; the message names the file."""


def array_names(path: str | Path) -> list[str]:
    """Return the names of the arrays in an .npz. Raises ArrayFileError for a damaged file, and OSError."""
    with _archive(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def read_arrays(path: str | Path, required: Sequence[str] = (), optional: Sequence[str] = ()) -> dict[str, NDArray]:
    """Read the arrays `required` of an .npz, and those of `optional` that it contains; others are not unpacked.

    Nothing is extracted to disk, so paths in names do no harm.

    Raises:
        ArrayFileError: the file is damaged, lacks an array, or one is pickled or larger than `LARGEST_BYTES`.
        OSError: it cannot be opened; FileNotFoundError if it does not exist.
    """
    arrays = {}
    with _archive(path) as archive:
        for name in (*required, *optional):
            member = _member(archive, f"{name}.npy") or _member(archive, name)
            if member is not None:
                with archive.open(member) as stream:
                    arrays[name] = _read(stream, member.file_size, f"{path}: {name!r}")
            elif name in required:
                raise ArrayFileError(f"{path} holds no array {name!r}: make it again")
    return arrays


def read_numbers(path: str | Path, required: Sequence[str] = (), optional: Sequence[str] = ()) -> dict[str, NDArray]:
    """As `read_arrays`; also raises ArrayFileError for arrays that are not finite numbers."""
    arrays = read_arrays(path, required, optional)
    for name, values in arrays.items():
        if values.dtype.kind not in "biuf":
            raise ArrayFileError(f"{path}: {name!r} holds {values.dtype}, not numbers: save it as numbers")
        if not np.isfinite(values).all():
            raise ArrayFileError(f"{path}: {name!r} holds NaN or infinite numbers: make it again")
    return arrays


def check_shapes(
    path: str | Path, arrays: Mapping[str, NDArray], shapes: Mapping[str, Sequence[int | str]], sizes: dict[str, int]
) -> None:
    """Check that `arrays` are numbers of these shapes. A letter is a size, the same in all arrays, added to `sizes`.

    Raises ArrayFileError, and KeyError for a missing array.
    """
    for name, shape in shapes.items():
        values = arrays[name]
        fits = values.ndim == len(shape) and values.dtype.kind in "fiu" and values.size > 0
        for expected, size in zip(shape, values.shape, strict=False):
            fits = fits and size == (sizes.setdefault(expected, size) if isinstance(expected, str) else expected)
        if not fits:
            expected_shape = tuple(sizes.get(s, s) if isinstance(s, str) else s for s in shape)
            raise ArrayFileError(
                f"{path}: {name!r} holds {values.dtype} {values.shape} instead of numbers of shape {expected_shape}"
            )


def read_npy(path: str | Path) -> NDArray:
    """Read an .npy file. Raises as `read_arrays`."""
    with Path(path).open("rb") as stream:
        return _read(stream, Path(path).stat().st_size, str(path))


def read_member(path: str | Path, name: str) -> bytes:
    """Read a file in a zip archive. Raises as `read_arrays`."""
    with _archive(path) as archive:
        member = _member(archive, name)
        if member is None:
            raise ArrayFileError(f"{path} holds no {name!r}: make it again")
        _check_size(member.file_size, f"{path}: {name!r}")
        return archive.read(member)


@contextlib.contextmanager
def _archive(path: str | Path) -> Iterator[zipfile.ZipFile]:
    with Path(path).open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                yield archive
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError) as e:
            raise ArrayFileError(f"{path} is not a whole .npz file ({e}): copy or export it again") from e


def _member(archive: zipfile.ZipFile, name: str) -> zipfile.ZipInfo | None:
    return archive.NameToInfo.get(name)


def _check_size(size: int, what: str) -> None:
    if size > LARGEST_BYTES:
        raise ArrayFileError(f"{what} unpacks to {size / 2**20:.0f} MB, more than {LARGEST_BYTES // 2**20}: cut it")


def _read(stream: IO[bytes], size: int, what: str) -> NDArray:
    """Read an array of `size` bytes including its header, which must agree with that size."""
    _check_size(size, what)
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran, dtype = read_header(stream)
    except (ValueError, KeyError, SyntaxError) as e:
        raise ArrayFileError(f"{what} is not an array of numpy's format: save it with numpy.save or savez") from e
    if dtype.hasobject:
        raise ArrayFileError(f"{what} holds pickled Python objects, which are never read: save it as plain arrays")
    wanted = math.prod(shape) * dtype.itemsize
    if not 0 <= wanted <= size:
        raise ArrayFileError(f"{what} is cut short: its header promises {wanted} bytes, {size} are there")
    data = stream.read(wanted)
    if len(data) < wanted:
        raise ArrayFileError(f"{what} is cut short: its header promises {wanted} bytes, {len(data)} are there")
    array = np.frombuffer(data, dtype)
    return (array.reshape(shape[::-1]).T if fortran else array.reshape(shape)).copy()
