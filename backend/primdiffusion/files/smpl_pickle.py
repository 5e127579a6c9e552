"""Read the pickles in which SMPL and its poses are distributed, joblib's too, without executing code from them.

A pickle is a program that may call any importable function. This reader maps every allowed global to one of the inert
records below, which only store their arguments, and rejects all others. `as_array` rebuilds arrays afterwards, so not
even numpy or scipy interprets the file's instructions. Operations that would take memory or C stack out of proportion
to the file are rejected. Reads files written by Python 2 (latin1 strings), chumpy, joblib, and old and new versions of
numpy and scipy; chumpy and joblib need not be installed.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .regular_files import FileError, read_regular

MOST_OPERATIONS, BYTES_AN_OPERATION = 300_000, 8
"""Operations of a small file, and bytes for each of a larger one; SMPL's have a few thousand."""
LARGEST_UNPACKED = 256 * 2**20
"""Bytes of a compressed file, unpacked."""
MOST_NUMBERS = 10_000_000
"""In sparse matrices as they become dense; the regressor of SMPL's joints has 165,360."""
MOST_LISTED = 2_000_000
"""Numbers in lists, each of which is visited; SMPL's arrays are not lists."""
MAX_NESTING = 8
"""Limit on nested chumpy selections; body models nest less."""
_DAMAGED = (
    pickle.UnpicklingError, ValueError, TypeError, LookupError, AttributeError, OverflowError, EOFError, zlib.error,
)  # fmt: skip
"""Exceptions of the unpickler where operations do not fit their values."""
_NUMBER_TYPE = re.compile(r"[biuf][1248]")
_TYPE_SIZE = re.compile(r"[biufcSU](\d{1,6})")


class Inert:
    """Constructor arguments and state of a pickled object."""

    arguments: tuple[object, ...]
    state: object

    def __new__(cls, *arguments: object) -> Inert:
        """Store the arguments: the operations of a pickle call __new__ or the class."""
        self = object.__new__(cls)
        self.arguments, self.state = arguments, None
        return self

    def __setstate__(self, state: object) -> None:
        """Store the state. The unpickler sets attributes itself where a class has no such method."""
        self.state = state


class _Array(Inert):
    """numpy's array: state (version, shape, dtype, column-major, raw bytes)."""


class _BufferArray(Inert):
    """numpy's array in protocol 5: arguments (raw bytes, dtype, shape, order)."""


class _Scalar(Inert):
    """numpy's scalar: arguments (dtype, raw bytes)."""


class _NumberType(Inert):
    """numpy's dtype: argument 0 such as "f8", state 1 the byte order."""


class _Latin1Bytes(Inert):
    """Bytes written as text by protocol 2: arguments (text, "latin1")."""


class _JoblibArray(Inert):
    """joblib's array: state with shape, order, dtype; the bytes follow in the file itself, after a padding."""

    stream: io.BytesIO
    raw: bytes

    def __setstate__(self, state: object) -> None:
        """Store the state, and the bytes behind it."""
        match state:
            case {"shape": tuple() as shape, "dtype": _NumberType(arguments=(str() as kind, *_)), **rest}:
                found = _TYPE_SIZE.fullmatch(kind)
            case _:
                raise ValueError("an array has no shape or type")
        if found is None or not all(isinstance(n, int) and n >= 0 for n in shape):
            raise ValueError("an array holds objects, not numbers")
        size = int(found[1]) * (4 if kind[0] == "U" else 1) * math.prod(shape)
        if rest.get("numpy_array_alignment_bytes") is not None:
            self.stream.seek(ord(self.stream.read(1)), io.SEEK_CUR)
        self.state, self.raw = state, self.stream.read(min(size, len(self.stream.getbuffer())))


class _Chumpy(Inert):
    """chumpy's array: state["x"]."""


class _ChumpySelection(Inert):
    """chumpy's indexing of another array: state["a"], ["idxs"], ["preferred_shape"]."""


class _SparseColumns(Inert):
    """scipy's compressed sparse columns: state["data"], ["indices"], ["indptr"], ["_shape"]."""


class _Reconstructed(Inert):
    """copyreg's object constructor of protocols 0 and 1: arguments (class, base, base state)."""

    def __new__(cls, kind: object, *_: object) -> Inert:
        if not (isinstance(kind, type) and issubclass(kind, Inert)):
            raise ValueError(f"it rebuilds a {type(kind).__name__}, which is not an array")
        return kind()


_GLOBALS: dict[tuple[str, str], type] = {
    ("numpy", "ndarray"): Inert,
    ("numpy", "dtype"): _NumberType,
    ("_codecs", "encode"): _Latin1Bytes,
    ("chumpy.ch", "Ch"): _Chumpy,
    ("chumpy", "Ch"): _Chumpy,
    ("chumpy.reordering", "Select"): _ChumpySelection,
    **{
        (f"numpy.{core}.{module}", name): kind
        for core in ("core", "_core")
        for module, name, kind in (
            ("multiarray", "_reconstruct", _Array),
            ("multiarray", "scalar", _Scalar),
            ("numeric", "_frombuffer", _BufferArray),
        )
    },
    **{(f"scipy.sparse{module}", "csc_matrix"): _SparseColumns for module in ("", ".csc", "._csc")},
    **{(module, "_reconstructor"): _Reconstructed for module in ("copy_reg", "copyreg")},
    **{(module, "object"): Inert for module in ("__builtin__", "builtins")},
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
        self._path = path
        self._joblib_array = type("_JoblibArray", (_JoblibArray,), {"stream": stream})

    def find_class(self, module: str, name: str) -> type:
        """Return an inert record. Raises FileError for other globals."""
        if (module, name) == ("joblib.numpy_pickle", "NumpyArrayWrapper"):
            return self._joblib_array
        try:
            return _GLOBALS[module, name]
        except KeyError:
            raise FileError(
                self._path,
                f"asks for the global {f'{module}.{name}':.80}, which arrays do not need, so nothing in it was run",
                "take it from its publisher again, or convert it to .npz where you trust it",
            ) from None


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
    """Load a pickle, the content of the file `path`, with inert records in place of objects.

    Raises:
        FileError: it names a global outside the list above, is not a pickle, or is truncated.
    """
    try:
        return _Unpickler(_unpacked(data), path).load()
    except FileError:
        raise
    except _DAMAGED as error:
        reason = " ".join(str(error).split())
        raise FileError(path, f"is not a whole pickle file ({reason:.80})", "download it again") from error


def array_of_objects(value: object) -> list[object]:
    """Return the elements of a pickled object array, such as the 0-d array in which `np.save` stores a dictionary.

    Raises:
        ValueError: the value is not an object array.
    """
    match value:
        case _Array(state=(_, tuple(), _NumberType(arguments=("O8" | "O", *_)), _, list() as objects)):
            return objects
    raise ValueError(f"a {type(value).__name__.strip('_')} is given instead of an array of objects")


def as_array(value: object, nesting: int = 0) -> np.ndarray:
    """Convert a value returned by `read_pickle` to a numeric array; sparse matrices become dense.

    Raises:
        ValueError: the value is not a plain array of numbers, or its parts contradict each other.
    """
    if nesting > MAX_NESTING:
        raise ValueError(f"an array is made from arrays nested more than {MAX_NESTING} deep")
    try:
        return _as_array(value, nesting)
    except (TypeError, LookupError, AttributeError, OverflowError, MemoryError) as error:
        raise ValueError(f"a stored array is damaged ({type(error).__name__}: {error})") from error


def _as_array(value: object, nesting: int) -> np.ndarray:
    match value:
        case np.ndarray():
            array = value
        case _Array(state=(_, tuple() as shape, kind, column_major, raw)):
            array = np.frombuffer(_raw_bytes(raw), _number_type(kind)).reshape(
                shape, order="F" if column_major else "C"
            )
        case _BufferArray(arguments=(raw, kind, tuple() as shape, str() as order)):
            array = np.frombuffer(_raw_bytes(raw), _number_type(kind)).reshape(
                shape, order="F" if order == "F" else "C"
            )
        case _JoblibArray(state={"shape": tuple() as shape, "dtype": kind, **rest}, raw=raw):
            array = np.frombuffer(raw, _number_type(kind)).reshape(
                shape, order="F" if rest.get("order") == "F" else "C"
            )
        case _Scalar(arguments=(kind, raw)):
            array = np.frombuffer(_raw_bytes(raw), _number_type(kind)).reshape(())
        case _ChumpySelection(state={"a": source, "idxs": indices, **rest}):
            array = as_array(source, nesting + 1).ravel()[as_array(indices, nesting + 1)]
            if "preferred_shape" in rest:
                array = array.reshape(tuple(int(n) for n in as_array(rest["preferred_shape"], nesting + 1)))
        case _Chumpy(state={"x": content}):
            array = as_array(content, nesting + 1)
        case _SparseColumns(state={"data": data, "indices": indices, "indptr": starts, "_shape": shape}):
            array = _dense(*(as_array(part, nesting + 1) for part in (data, indices, starts, shape)))
        case list() | tuple() | int() | float():
            _check_count(value)
            array = np.asarray(value)
        case _:
            raise ValueError(f"a {type(value).__name__.strip('_')} is given instead of an array of numbers")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"an array holds {array.dtype} where numbers belong")
    return array


def _check_count(value: object) -> None:
    """Raise ValueError for too many numbers in nested lists; one list may be contained many times."""
    level, count = [value], 1
    for _ in range(MAX_NESTING + 1):
        lists = [entry for entry in level if isinstance(entry, list | tuple)]
        count += sum(map(len, lists))
        if count > MOST_LISTED:
            raise ValueError(f"a list holds more than {MOST_LISTED} numbers")
        level = [entry for inner in lists for entry in inner]
        if not level:
            return
    raise ValueError(f"lists are nested more than {MAX_NESTING} deep")


def _number_type(kind: object) -> np.dtype:
    if not isinstance(kind, _NumberType) or not kind.arguments or not _NUMBER_TYPE.fullmatch(str(kind.arguments[0])):
        raise ValueError("an array holds elements that are not numbers")
    order = kind.state[1] if isinstance(kind.state, tuple) else "|"
    return np.dtype(str(kind.arguments[0])).newbyteorder(order if order in ("<", ">") else "=")


def _raw_bytes(raw: object) -> bytes | bytearray:
    if isinstance(raw, _Latin1Bytes) and raw.arguments[1:] in (("latin1",), ("latin-1",)):
        raw = raw.arguments[0]
    if isinstance(raw, str):
        return raw.encode("latin1")
    if isinstance(raw, bytes | bytearray):
        return raw
    raise ValueError(f"a {type(raw).__name__.strip('_')} is given instead of an array's bytes")


def _dense(data: np.ndarray, indices: np.ndarray, starts: np.ndarray, shape: np.ndarray) -> np.ndarray:
    rows, columns = (int(n) for n in shape)
    if min(rows, columns) < 0 or rows * columns > MOST_NUMBERS or len(starts) != columns + 1:
        raise ValueError(f"a sparse matrix claims {rows} x {columns} entries, which its other parts contradict")
    counts = np.diff(starts)
    if starts[0] != 0 or (counts < 0).any() or not len(data) == len(indices) == starts[-1]:
        raise ValueError("a sparse matrix has columns that do not follow each other")
    if len(indices) and not 0 <= indices.min() <= indices.max() < rows:
        raise ValueError(f"a sparse matrix has an entry outside its {rows} rows")
    dense = np.zeros((rows, columns), data.dtype)
    np.add.at(dense, (indices, np.repeat(np.arange(columns), counts)), data)
    return dense
