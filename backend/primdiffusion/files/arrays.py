"""Read untrusted .npz and .npy files by numpy, without pickles and under the sizes that their own headers state."""

from __future__ import annotations

import contextlib
import io
import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from numpy.typing import NDArray

from .regular_files import FileError, open_regular

LARGEST_BYTES = 512 * 2**20
"""Largest size of what one call reads: small files can claim petabytes. An hour of motion at 60 frames/s takes 285
MB."""
MOST_REPEATED, LARGEST_RATIO = 64 * 2**20, 200
"""Bytes from which on what one call reads may not be larger than this many times its compressed size: zeros are."""
MOST_BODY_VALUES = 32_000_000
"""Numbers that a file of a body, or of a human on one, may hold: SMPL-X's with all components has 28 million."""
LARGEST_NUMBER = 1e9
LARGEST_FILE = 2**31
_KINDS = "biufUS"
"""Numbers and text: no complex numbers, dates or records."""
_UNREADABLE = (
    zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, struct.error, EOFError, OSError, NotImplementedError,
    RuntimeError, ValueError, TypeError, OverflowError, LookupError,
)  # fmt: skip
"""Exceptions of zipfile and numpy for damaged files."""


def array_names(path: str | Path) -> list[str]:
    """Return the names of the arrays in an .npz. Raises FileError for a damaged file, and OSError."""
    with _archive(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def array_shape(path: str | Path, name: str) -> tuple[int, ...]:
    """Return the shape of an array without reading its values. Raises as `read_arrays`."""
    with _archive(path) as archive, archive.open(member := _required_member(archive, path, name)) as stream:
        return _header(stream, member.file_size, path, name)


def read_arrays(
    path: str | Path, required: Sequence[str] = (), optional: Sequence[str] = (), *, most_values: int | None = None
) -> dict[str, NDArray]:
    """Read the arrays `required` of an .npz, and those of `optional` that it contains; others are not unpacked.

    Nothing is extracted to disk, so paths in names do no harm. `most_values` is for callers that convert them to larger
    types: the values of all arrays together.

    Raises:
        FileError: the file is damaged, lacks an array, or one is pickled or larger than `LARGEST_BYTES`.
        OSError: it cannot be opened; FileNotFoundError if it does not exist.
    """
    arrays, unpacked, packed, values = {}, 0, 0, 0
    with _archive(path) as archive:
        for name in (*required, *optional):
            if name in optional and _member(archive, name) is None:
                continue
            member = _required_member(archive, path, name)
            unpacked, packed = unpacked + member.file_size, packed + member.compress_size
            _check_size(unpacked, packed, path, name)
            with archive.open(member) as stream:
                values += math.prod(_header(stream, member.file_size, path, name))
                if most_values is not None and values > most_values:
                    raise _error(path, name, f"makes it {values} values, more than {most_values}", "save fewer")
                stream.seek(0)
                arrays[name] = np.load(stream, allow_pickle=False)
    return arrays


def read_numbers(
    path: str | Path, required: Sequence[str] = (), optional: Sequence[str] = (), *, most_values: int | None = None
) -> dict[str, NDArray]:
    """Same as `read_arrays`; also raises FileError for arrays that are not finite numbers."""
    arrays = read_arrays(path, required, optional, most_values=most_values)
    for name, values in arrays.items():
        if values.dtype.kind not in "biuf":
            raise FileError(path, f"holds {name!r} as {values.dtype}, not numbers", "save it as numbers")
        if not all_finite(values):
            raise FileError(path, f"holds NaN or infinite numbers in {name!r}", "make it again")
    return arrays


def all_finite(values: NDArray) -> bool:
    """Whether no number is NaN, infinite, or too large for products in float32."""
    if not np.isfinite(values).all() or values.size == 0:
        return values.size == 0
    # not of magnitudes: the smallest integer has none
    return float(values.max()) <= LARGEST_NUMBER and float(values.min()) >= -LARGEST_NUMBER


def check_shapes(
    path: str | Path, arrays: Mapping[str, NDArray], shapes: Mapping[str, Sequence[int | str]], sizes: dict[str, int]
) -> None:
    """Check that `arrays` are numbers of these shapes. A letter is a size, the same in all arrays, added to `sizes`.

    Raises FileError, and KeyError for a missing array.
    """
    for name, shape in shapes.items():
        values = arrays[name]
        fits = values.ndim == len(shape) and values.dtype.kind in "fiu" and values.size > 0
        for expected, size in zip(shape, values.shape, strict=False):
            fits = fits and size == (sizes.setdefault(expected, size) if isinstance(expected, str) else expected)
        if not fits:
            expected_shape = tuple(sizes.get(s, s) if isinstance(s, str) else s for s in shape)
            found = f"holds {name!r} as {values.dtype} {values.shape}, not as numbers {expected_shape}"
            raise FileError(path, found, "make it again")


def read_npy(path: str | Path) -> NDArray:
    """Read an .npy file. Raises as `read_arrays`."""
    with open_regular(path, LARGEST_BYTES) as stream, _damage_named(path):
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        _header(stream, size, path)
        stream.seek(0)
        return np.load(stream, allow_pickle=False)


def read_pickled_bytes(path: str | Path, name: str) -> bytes:
    """Return the pickle in an array of objects, for a reader that runs nothing of it. Raises as `read_arrays`."""
    with _archive(path) as archive:
        member = _required_member(archive, path, name)
        _check_size(member.file_size, member.compress_size, path, name)
        with archive.open(member) as stream:
            _header(stream, member.file_size, path, name, kinds="O")
            return stream.read()


def write_deflated(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write an .npz at the fastest level: higher ones take long and gain little. Raises one OSError for a full disk."""
    archive = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    try:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(values), allow_pickle=False)
    except BaseException:
        with contextlib.suppress(OSError, ValueError):  # closing writes again, which a full disk rejects again
            archive.close()
        raise
    archive.close()


@contextlib.contextmanager
def _damage_named(path: str | Path) -> Iterator[None]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of headers that Python 2 wrote
            yield
    except FileError:
        raise
    except _UNREADABLE as e:
        reason = f"is damaged, or holds no arrays ({str(e)[:100]})"
        raise FileError(path, reason, "download it, or make it again") from e


@contextlib.contextmanager
def _archive(path: str | Path) -> Iterator[zipfile.ZipFile]:
    with open_regular(path, LARGEST_FILE) as file, _damage_named(path), zipfile.ZipFile(file) as archive:
        yield archive


def _member(archive: zipfile.ZipFile, name: str) -> zipfile.ZipInfo | None:
    return archive.NameToInfo.get(f"{name}.npy") or archive.NameToInfo.get(name)


def _required_member(archive: zipfile.ZipFile, path: str | Path, name: str) -> zipfile.ZipInfo:
    member = _member(archive, name)
    if member is None:
        raise FileError(path, f"holds no array {name!r}", "make it again")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others unpack without a limit
        raise _error(path, name, "is compressed in another way than numpy's", "save it with numpy.savez")
    return member


def _error(path: str | Path, name: str, reason: str, remedy: str) -> FileError:
    """The fault of an array: of the member `name` of an archive, or of a file of its own."""
    return FileError(path, f"holds {name!r:.60}, which {reason}" if name else reason, remedy)


def _check_size(size: int, packed: int, path: str | Path, name: str) -> None:
    if size > LARGEST_BYTES or size > max(MOST_REPEATED, LARGEST_RATIO * packed):
        reason = f"unpacks to {size / 2**20:.0f} MB from {packed / 2**20:.1f} MB"
        raise _error(path, name, reason, "split it into smaller files")


def _header(
    stream: IO[bytes] | BinaryIO, size: int, path: str | Path, name: str = "", kinds: str = _KINDS
) -> tuple[int, ...]:
    """Read the shape of an array that fits into `size` bytes. Raises FileError."""
    try:
        version = np.lib.format.read_magic(stream)  # type: ignore[arg-type]
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, _, dtype = read(stream)  # type: ignore[arg-type]
    except Exception as e:  # numpy evaluates the header as an expression of Python
        raise _error(path, name, "is not an array of numpy's format", "save it with numpy.save or savez") from e
    if dtype.kind not in kinds or dtype.itemsize <= 0:  # sizes of long texts wrap
        reason = "is pickled, and pickles are not read" if dtype.hasobject else f"is an array of {dtype!s:.60}"
        raise _error(path, name, reason, "save it as an array of numbers or text")
    if min(shape, default=0) < 0 or (kinds == _KINDS and math.prod(shape) * dtype.itemsize > size):
        raise _error(path, name, f"claims the shape {shape!s:.60} in {size} bytes", "download it, or make it again")
    return shape
