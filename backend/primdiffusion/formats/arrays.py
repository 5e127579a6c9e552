"""Read untrusted .npz and .npy files: no pickles, no arrays larger than their file, no extraction to disk."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import io
import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from numpy.typing import NDArray

from .regular_files import FileContent, FileError, open_regular

LARGEST_BYTES = 512 * 2**20
"""Largest size of what one call reads: small files can claim petabytes. An hour of motion at 60 frames/s takes 285
MB."""
MOST_REPEATED, LARGEST_RATIO = 64 * 2**20, 200
"""Bytes from which on what one call reads may not be larger than this many times its compressed size: zeros are."""
MOST_BODY_VALUES = 32_000_000
"""Numbers that a file of a body, or of a human on one, may hold: SMPL-X's with all components has 28 million."""
LARGEST_NUMBER = 1e9
LARGEST_FILE = 2**31
_LARGEST_DIRECTORY = 4 * 2**20
"""Of a zip archive's list of names, bytes; also of a single read."""
_LONGEST_HEADER = 10_000
"""Of an array, bytes, as in numpy."""
_CHUNK = 2**20
_KINDS = "biufUS"
"""Numbers and text: no complex numbers, dates or records."""
_UNREADABLE = (
    zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, struct.error, EOFError, OSError, NotImplementedError,
    RuntimeError, ValueError, OverflowError, LookupError,
)  # fmt: skip
_HEADER_ERRORS = (
    ValueError, KeyError, SyntaxError, TypeError, MemoryError, RecursionError, OverflowError, struct.error,
    tokenize.TokenError,
)  # fmt: skip


Source = str | Path | FileContent
"""A file by its path, or as it was read before."""


@dataclasses.dataclass(frozen=True)
class _Place:
    """Where an array is: a file of its own, or the member `name` of an archive."""

    path: Source
    name: str = ""

    def error(self, reason: str, remedy: str) -> FileError:
        return FileError(self.path, f"holds {self.name!r:.60}, which {reason}" if self.name else reason, remedy)


def array_names(path: Source) -> list[str]:
    """Return the names of the arrays in an .npz. Raises FileError for a damaged file, and OSError."""
    with _archive(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def array_shape(path: str | Path, name: str) -> tuple[int, ...]:
    """Return the shape of an array without reading its values. Raises as `read_arrays`."""
    with _archive(path) as archive:
        member = _needed(archive, path, name)
        place = _Place(path, name)
        _check_size(member.file_size, place)
        with archive.open(member) as stream:
            return _header(stream, member.file_size, place)[0]


def read_arrays(
    path: Source, required: Sequence[str] = (), optional: Sequence[str] = (), *, most_values: int | None = None
) -> dict[str, NDArray]:
    """Read the arrays `required` of an .npz, and those of `optional` that it contains; others are not unpacked.

    Nothing is extracted to disk, so paths in names do no harm. `most_values` is for callers that convert them to larger
    types: the values of all arrays together.

    Raises:
        FileError: the file is damaged, lacks an array, or one is pickled or larger than `LARGEST_BYTES`.
        OSError: it cannot be opened; FileNotFoundError if it does not exist.
    """
    arrays, total, packed, values = {}, 0, 0, 0
    with _archive(path) as archive:
        for name in (*required, *optional):
            if name in optional and _member(archive, name) is None:
                continue
            member = _needed(archive, path, name)
            total, packed, place = total + member.file_size, packed + member.compress_size, _Place(path, name)
            _check_size(total, place)
            _check_ratio(total, packed, place)
            with archive.open(member) as stream:
                head = _header(stream, member.file_size, place)
                values += math.prod(head[0])
                if most_values is not None and values > most_values:
                    raise place.error(f"makes it {values} values, more than {most_values}", "save fewer in a file")
                arrays[name] = _filled(stream, *head, place)
    return arrays


def read_numbers(
    path: str | Path, required: Sequence[str] = (), optional: Sequence[str] = (), *, most_values: int | None = None
) -> dict[str, NDArray]:
    """As `read_arrays`; also raises FileError for arrays that are not finite numbers."""
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


def read_npy(path: Source) -> NDArray:
    """Read an .npy file. Raises as `read_arrays`."""
    with _npy(path) as (stream, size):
        place = _Place(path)
        _check_size(size, place)
        return _filled(stream, *_header(stream, size, place), place)


def map_npy(path: str | Path) -> NDArray:
    """Map an .npy file of any size into memory, read-only. Raises as `read_arrays`."""
    with contextlib.closing(open_regular(path, 2**62)) as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        shape, fortran, dtype = _header(stream, size, _Place(path))
        order = "F" if fortran else "C"
        # of the open file, whose header was checked: another one may have taken its name
        return np.memmap(stream, dtype, "r", stream.tell(), shape, order)  # type: ignore[call-overload]


def read_pickled_bytes(path: str | Path, name: str) -> bytes:
    """Return the pickle in an array of objects, for a reader that runs nothing of it. Raises as `read_arrays`."""
    with _archive(path) as archive:
        member, place = _needed(archive, path, name), _Place(path, name)
        _check_size(member.file_size, place)
        with archive.open(member) as stream:
            _, _, dtype = _head(stream, place)
            if not dtype.hasobject:
                raise place.error(f"is {dtype}, not a dictionary of arrays", "download it again")
            return b"".join(iter(lambda: stream.read(_CHUNK), b""))


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


class _Reads:
    """A file whose single reads are limited: `zipfile` reads the whole list of names at once."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.seek, self.tell, self.seekable = file, file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size if 0 <= size <= _LARGEST_DIRECTORY else _LARGEST_DIRECTORY + 1)
        if len(data) > _LARGEST_DIRECTORY:
            raise zipfile.BadZipFile("it lists too many names")
        return data


@contextlib.contextmanager
def _archive(path: Source) -> Iterator[zipfile.ZipFile]:
    with open_regular(path, LARGEST_FILE) as file, _archive_in(file, path) as archive:
        yield archive


@contextlib.contextmanager
def _archive_in(file: BinaryIO, path: Source) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(_Reads(file)) as archive:  # type: ignore[arg-type]
            _check_names(path, [name.removesuffix(".npy") for name in archive.namelist()])
            yield archive
    except FileError:
        raise
    except _UNREADABLE as e:
        reason = f"is damaged, or no archive of arrays ({str(e)[:100]})"
        raise FileError(path, reason, "download it, or make it again") from e


def _check_names(path: Source, names: Sequence[str]) -> None:
    """Check that names differ: of two members of one name, readers choose different ones."""
    if len(set(names)) < len(names):
        twice = next(name for name, count in collections.Counter(names).items() if count > 1)
        raise FileError(path, f"holds {twice!r:.60} twice", "save it again")


@contextlib.contextmanager
def _npy(path: Source) -> Iterator[tuple[BinaryIO, int]]:
    with open_regular(path, LARGEST_BYTES) as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        yield stream, size


def _member(archive: zipfile.ZipFile, name: str) -> zipfile.ZipInfo | None:
    return archive.NameToInfo.get(f"{name}.npy") or archive.NameToInfo.get(name)


def _needed(archive: zipfile.ZipFile, path: Source, name: str) -> zipfile.ZipInfo:
    member = _member(archive, name)
    if member is None:
        raise FileError(path, f"holds no array {name!r}", "make it again")
    place = _Place(path, name)
    if member.flag_bits & 1:
        raise place.error("is encrypted", "save it without a password")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others unpack without a limit
        raise place.error("is compressed in another way than numpy's", "save it with numpy.savez")
    _check_ratio(member.file_size, member.compress_size, place)
    return member


def _check_ratio(size: int, packed: int, place: _Place) -> None:
    if size > max(MOST_REPEATED, LARGEST_RATIO * packed):
        raise place.error(f"unpacks to {size / 2**20:.0f} MB of the same", "split it into smaller files")


def _check_size(size: int, place: _Place) -> None:
    if size > LARGEST_BYTES:
        most = LARGEST_BYTES // 2**20
        raise place.error(f"unpacks to {size / 2**20:.0f} MB, more than {most}", "split it into smaller files")


def _head(stream: IO[bytes], place: _Place) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Read the header of an array: shape, column-major, dtype."""
    try:
        start = stream.read(8)
        wide = {b"\x93NUMPY\x01\x00": 2, b"\x93NUMPY\x02\x00": 4}[start]
        length = stream.read(wide)
        count = int.from_bytes(length, "little")
        if count > _LONGEST_HEADER:
            raise ValueError("a long header")
        text = io.BytesIO(length + stream.read(count))
        read = np.lib.format.read_array_header_1_0 if wide == 2 else np.lib.format.read_array_header_2_0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of headers that Python 2 wrote
            shape, fortran, dtype = read(text)
        if len(shape) > 32 or not all(type(side) is int and 0 <= side < 2**62 for side in shape):
            raise ValueError("an impossible shape")
    except _HEADER_ERRORS as e:
        raise place.error("is not an array of numpy's format", "save it with numpy.save or savez") from e
    if not dtype.hasobject and (dtype.kind not in _KINDS or dtype.itemsize <= 0):  # sizes of long texts wrap
        raise place.error(f"is an array of {dtype!s:.60}, not of numbers or text", "save it as one of these")
    return shape, fortran, dtype


def _header(stream: IO[bytes], size: int, place: _Place) -> tuple[tuple[int, ...], bool, np.dtype]:
    """As `_head`, of numbers or text that fit into `size` bytes."""
    shape, fortran, dtype = _head(stream, place)
    if dtype.hasobject:
        raise place.error("is pickled, and pickles are never read", "save it as plain arrays")
    wanted = math.prod(shape) * dtype.itemsize
    if wanted > size:
        raise _cut_short(place, wanted if wanted < 2**63 else "countless", size)
    return shape, fortran, dtype


def _cut_short(place: _Place, promised: int | str, found: int) -> FileError:
    reason = f"is cut short (its header promises {promised} bytes, {found} are there)"
    return place.error(reason, "download it, or make it again")


def _filled(stream: IO[bytes], shape: tuple[int, ...], fortran: bool, dtype: np.dtype, place: _Place) -> NDArray:
    """Read the values of an array, which follow its header."""
    raw = np.empty(math.prod(shape) * dtype.itemsize, np.uint8)  # memory is taken as it is filled
    filled = 0
    while filled < raw.size:
        chunk = stream.read(min(_CHUNK, raw.size - filled))
        if not chunk:
            raise _cut_short(place, raw.size, filled)
        raw[filled : filled + len(chunk)] = np.frombuffer(chunk, np.uint8)
        filled += len(chunk)
    array = raw.view(dtype)
    return array.reshape(shape[::-1]).T if fortran else array.reshape(shape)
