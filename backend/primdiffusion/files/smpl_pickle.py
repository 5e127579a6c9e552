"""Read the pickles in which SMPL and its poses are distributed, joblib's too, without executing code from them.

A pickle is a program that may call any importable function. Here every allowed global is a `Stored`, which keeps its
arguments and its state, and all others are rejected; `as_array` makes arrays of them afterwards. Operations that would
take memory or C stack out of proportion to the file are rejected too. Reads files of Python 2 (latin1 strings), chumpy,
joblib, and old and new versions of numpy and scipy; chumpy and joblib need not be installed.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .regular_files import FileError, as_file_error, read_regular

MOST_OPERATIONS, BYTES_AN_OPERATION = 300_000, 8
"""Operations of a small file, and bytes for each of a larger one; SMPL's have a few thousand."""
LARGEST_UNPACKED = 256 * 2**20
"""Bytes of a compressed file, unpacked."""
MOST_NUMBERS = 10_000_000
"""Largest number of values of sparse matrices, as they become dense; the regressor of SMPL's joints has 165,360."""
MOST_LISTED = 2_000_000
"""Numbers in lists, each of which is visited; SMPL's arrays are not lists."""
MAX_NESTING = 8
"""Limit on lists in lists, and on nested chumpy selections; body models nest less."""
_NUMBER_TYPE = re.compile(r"[biuf][1248]")
_TYPE_SIZE = re.compile(r"[biufcSU](\d{1,6})")


class Stored:
    """Constructor arguments and state of a pickled object."""

    kind = ""
    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: object) -> Stored:
        """Store the arguments: the operations of a pickle call __new__ or the class."""
        self = object.__new__(cls)
        self.arguments, self.state = arguments, None
        return self

    def __setstate__(self, state: object) -> None:
        """Store the state. The unpickler sets attributes itself where a class has no such method."""
        self.state = state


class _Reconstructed(Stored):
    """copyreg's object constructor of protocols 0 and 1: arguments (class, base, base state)."""

    def __new__(cls, kind: object, *_: object) -> Stored:
        if not (isinstance(kind, type) and issubclass(kind, Stored)):
            raise ValueError(f"it rebuilds a {type(kind).__name__}, which is not an array")
        return kind()


class _JoblibArray(Stored):
    """joblib's array: state with shape, order, dtype; the bytes follow in the file itself, after a padding."""

    kind = "joblib array"
    stream: io.BytesIO
    raw: bytes

    def __setstate__(self, state: object) -> None:
        """Store the state, and the bytes behind it."""
        match state:
            case {"shape": tuple() as shape, "dtype": Stored(kind="dtype", arguments=(str() as name, *_)), **rest}:
                size = _TYPE_SIZE.fullmatch(name)
            case _:
                raise ValueError("an array has no shape or type")
        if size is None or not all(isinstance(n, int) and n >= 0 for n in shape):
            raise ValueError("an array holds objects, not numbers")
        if rest.get("numpy_array_alignment_bytes") is not None:
            self.stream.seek(ord(self.stream.read(1)), io.SEEK_CUR)
        length = int(size[1]) * (4 if name[0] == "U" else 1) * math.prod(shape)
        self.state, self.raw = state, self.stream.read(min(length, len(self.stream.getbuffer())))


_KINDS = {
    "object": ("builtins.object", "__builtin__.object", "numpy.ndarray"),
    "dtype": ("numpy.dtype",),
    "latin1": ("_codecs.encode",),
    "array": ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct"),
    "scalar": ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar"),
    "buffer": ("numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer"),
    "chumpy": ("chumpy.ch.Ch", "chumpy.Ch"),
    "selection": ("chumpy.reordering.Select",),
    "columns": ("scipy.sparse.csc_matrix", "scipy.sparse.csc.csc_matrix", "scipy.sparse._csc.csc_matrix"),
}
"""Globals that are allowed, by what they make."""
_GLOBALS: dict[str, type[Stored]] = {
    "copyreg._reconstructor": _Reconstructed,
    "copy_reg._reconstructor": _Reconstructed,
    **{
        name: kind
        for made, names in _KINDS.items()
        for kind in [type(made, (Stored,), {"kind": made})]
        for name in names
    },
}


def _operations() -> dict[int, Callable[[Any], None]]:
    """Python's operations by their byte, without sets and with dictionaries whose keys are not tuples: Python hashes
    tuples in tuples recursively."""
    known = dict(pickle._Unpickler.dispatch)  # pyright: ignore[reportAttributeAccessIssue]
    for code in (pickle.ADDITEMS, pickle.FROZENSET):
        del known[code[0]]
    for code in (pickle.SETITEM, pickle.SETITEMS, pickle.DICT):
        known[code[0]] = _of_names(known[code[0]])
    known[pickle.BYTEARRAY8[0]] = known[pickle.BINBYTES8[0]]  # which reads no more than there is
    return known


def _of_names(operation: Callable[[Any], None]) -> Callable[[Any], None]:
    def checked(unpickler: Any) -> None:
        if any(isinstance(key, tuple) for key in unpickler.stack[-2::-2]):
            raise ValueError("the key of a dictionary is a tuple")
        operation(unpickler)

    return checked


_OPERATIONS = _operations()


class _Counted(dict[int, Callable[[Any], None]]):
    """Operations, of which as many may run as the file's size allows."""

    def __init__(self, size: int) -> None:
        super().__init__(_OPERATIONS)
        self._left = max(MOST_OPERATIONS, size // BYTES_AN_OPERATION)

    def __getitem__(self, code: int) -> Callable[[Any], None]:
        """An operation, to run it. Raises ValueError after too many, KeyError."""
        self._left -= 1
        if self._left < 0:
            raise ValueError("it has more operations than arrays need")
        return super().__getitem__(code)


class _Unpickler(pickle._Unpickler):  # pyright: ignore[reportAttributeAccessIssue]
    """Python's unpickler in Python, which reads from its stream no more than an operation needs: joblib puts arrays
    between operations."""

    def __init__(self, data: bytes, path: str | Path) -> None:
        stream = io.BytesIO(data)
        super().__init__(stream, encoding="latin1")
        self.dispatch = _Counted(len(data))  # pyright: ignore[reportAttributeAccessIssue]
        joblib_array = type("_JoblibArray", (_JoblibArray,), {"stream": stream})
        self._path, self._globals = path, {**_GLOBALS, "joblib.numpy_pickle.NumpyArrayWrapper": joblib_array}

    def find_class(self, module: str, name: str) -> type[Stored]:
        """Return what stands for an allowed global. Raises FileError for other globals."""
        if (wanted := f"{module}.{name}") in self._globals:
            return self._globals[wanted]
        raise FileError(
            self._path,
            f"asks for the global {wanted:.80}, which arrays do not need, so nothing in it was run",
            "take it from its publisher again, or convert it to .npz where you trust it",
        )


def _unpacked(data: bytes) -> bytes:
    """The pickle in data that joblib may have compressed. Raises ValueError for one that is too large."""
    if data[:1] != b"x":
        return data
    unpacking = zlib.decompressobj()
    unpacked = unpacking.decompress(data, LARGEST_UNPACKED)
    if not unpacking.eof:
        raise ValueError("it is truncated, or too large unpacked")
    return unpacked


def read_pickle(path: Path, limit: int) -> dict[str, object]:
    """Return the dictionary in an SMPL pickle of at most `limit` bytes; convert values to arrays with `as_array`.

    Raises:
        FileError: as `load_restricted`, or it does not hold a dictionary.
        OSError: it cannot be opened.
    """
    content = load_restricted(read_regular(path, limit), path)
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        kind = type(content).__name__
        raise FileError(path, f"holds no dictionary of named arrays but a {kind}", "use a body model in SMPL's format")
    return content


def load_restricted(data: bytes, path: str | Path) -> object:
    """Load a pickle, the content of the file `path`, with `Stored` in place of objects.

    Raises:
        FileError: it names a global outside the list above, is not a pickle, or is truncated.
    """
    damage = (pickle.UnpicklingError, EOFError, struct.error, zlib.error)
    with as_file_error(path, "is not a whole pickle file", "download it again", *damage):
        return _Unpickler(_unpacked(data), path).load()


def array_of_objects(value: object) -> list[object]:
    """Return the elements of a pickled object array, such as the 0-d array in which `np.save` stores a dictionary.

    Raises:
        ValueError: the value is not an object array.
    """
    match value:
        case Stored(
            kind="array", state=(_, tuple(), Stored(kind="dtype", arguments=("O8" | "O", *_)), _, list() as objects)
        ):
            return objects
    raise ValueError(f"{_named(value)} is given instead of an array of objects")


def as_array(value: object, nesting: int = 0) -> np.ndarray:
    """Convert a value returned by `read_pickle` to a numeric array; sparse matrices become dense.

    Raises:
        ValueError: the value is not a plain array of numbers, or its parts contradict each other.
    """
    if nesting > MAX_NESTING:
        raise ValueError(f"an array is made from arrays nested more than {MAX_NESTING} deep")
    try:
        array = _as_array(value, nesting)
    except (TypeError, LookupError, AttributeError, OverflowError, MemoryError) as error:
        raise ValueError(f"a stored array is damaged ({type(error).__name__}: {error})") from error
    if array.dtype.kind not in "biuf":
        raise ValueError(f"an array holds {array.dtype} where numbers belong")
    return array


def _as_array(value: object, nesting: int) -> np.ndarray:
    def part(stored: object) -> np.ndarray:
        return as_array(stored, nesting + 1)

    match value:
        case np.ndarray():
            return value
        case Stored(kind="array", state=(_, tuple() as shape, kind, by_columns, raw)):
            return _numbers(raw, kind, shape, by_columns)
        case Stored(kind="buffer", arguments=(raw, kind, tuple() as shape, str() as order)):  # of protocol 5
            return _numbers(raw, kind, shape, order == "F")
        case _JoblibArray(state={"shape": shape, "dtype": kind, **rest}, raw=raw):
            return _numbers(raw, kind, shape, rest.get("order") == "F")
        case Stored(kind="scalar", arguments=(kind, raw)):
            return _numbers(raw, kind, (), False)
        case Stored(kind="selection", state={"a": source, "idxs": indices, **rest}):
            chosen = part(source).ravel()[part(indices)]
            return chosen.reshape([int(n) for n in part(rest.get("preferred_shape", list(chosen.shape)))])
        case Stored(kind="chumpy", state={"x": content}):
            return part(content)
        case Stored(kind="columns", state={"data": data, "indices": indices, "indptr": starts, "_shape": shape}):
            return _dense(part(data), part(indices), part(starts), part(shape))
        case list() | tuple() | int() | float():
            _check_count(value)
            return np.asarray(value)
    raise ValueError(f"{_named(value)} is given instead of an array of numbers")


def _named(value: object) -> str:
    return f"a {value.kind if isinstance(value, Stored) else type(value).__name__}"


def _check_count(value: object) -> None:
    """Raise ValueError for too many numbers in nested lists; one list may be contained many times."""
    level, count = [value], 0
    for _ in range(MAX_NESTING + 2):
        lists = [entry for entry in level if isinstance(entry, list | tuple)]
        count += sum(map(len, lists))
        if count > MOST_LISTED:
            raise ValueError(f"a list holds more than {MOST_LISTED} numbers")
        level = [entry for inner in lists for entry in inner]
    if level:
        raise ValueError(f"lists are nested more than {MAX_NESTING} deep")


def _numbers(raw: object, kind: object, shape: tuple[int, ...], by_columns: bool) -> np.ndarray:
    """The array of stored bytes, which protocol 2 writes as text."""
    match kind:
        case Stored(kind="dtype", arguments=(str() as name, *_), state=state) if _NUMBER_TYPE.fullmatch(name):
            order = state[1] if isinstance(state, tuple) and state[1] in ("<", ">") else "="
        case _:
            raise ValueError("an array holds elements that are not numbers")
    match raw:
        case Stored(kind="latin1", arguments=(raw, "latin1" | "latin-1")):
            pass
    content = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(content, bytes | bytearray):
        raise ValueError(f"{_named(raw)} is given instead of an array's bytes")
    return np.frombuffer(content, np.dtype(name).newbyteorder(order)).reshape(shape, order="F" if by_columns else "C")


def _dense(data: np.ndarray, indices: np.ndarray, starts: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """The matrix of compressed sparse columns."""
    rows, columns = (int(n) for n in shape)
    counts = np.diff(starts)
    if not (
        min(rows, columns) >= 0 and rows * columns <= MOST_NUMBERS and len(starts) == columns + 1
        and starts[0] == 0 and (counts >= 0).all() and len(data) == len(indices) == starts[-1]
        and 0 <= indices.min(initial=0) <= indices.max(initial=0) < max(rows, 1)
    ):  # fmt: skip
        raise ValueError(f"a sparse matrix claims {rows} x {columns} entries, which its other parts contradict")
    dense = np.zeros((rows, columns), data.dtype)
    np.add.at(dense, (indices, np.repeat(np.arange(columns), counts)), data)
    return dense
