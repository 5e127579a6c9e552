"""Read the pickles in which SMPL is distributed, without executing code from them.

A pickle is a program that may call any importable function. This reader maps every allowed global to one of the inert
records below, which only store their arguments, and rejects all others. `as_array` rebuilds arrays afterwards, so not
even numpy or scipy interprets the file's instructions. Before Python's unpickler runs, a scan of the operations rejects
those that would take memory, time or C stack out of proportion to the file. Reads files written by Python 2 (latin1
strings), chumpy, and old and new versions of numpy and scipy; chumpy need not be installed.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import re
from pathlib import Path

import numpy as np

from .regular_files import FileContent, FileError

MOST_OPERATIONS = 300_000
"""SMPL's files have a few thousand: their arrays are one string each. Indices of the memo, for which the unpickler
reserves memory, are below it too."""
MOST_TUPLES = 2000
"""Some six for each array. Tuples in tuples are hashed recursively if they are the key of a dictionary."""
MOST_NUMBERS = 10_000_000
"""In sparse matrices as they become dense; the regressor of SMPL's joints has 165,360."""
MOST_LISTED = 2_000_000
"""Numbers in lists, each of which is visited; SMPL's arrays are not lists."""
MAX_NESTING = 8
"""Limit on nested chumpy selections; body models nest less."""
_DAMAGED = (
    pickle.UnpicklingError, ValueError, TypeError, LookupError, AttributeError, OverflowError, EOFError,
)  # fmt: skip
"""What the unpickler raises where operations do not fit their values."""
_NUMBER_TYPE = re.compile(r"[biuf][1248]")


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


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, path: str | Path) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")
        self._path = path

    def find_class(self, module: str, name: str) -> type:
        """Return an inert record. Raises FileError for other globals."""
        try:
            return _GLOBALS[module, name]
        except KeyError:
            raise FileError(
                self._path,
                f"asks for the global {f'{module}.{name}':.80}, which arrays do not need, so nothing in it was run",
                "take it from its publisher again, or convert it to .npz where you trust it",
            ) from None


class _Scanned(io.BytesIO):
    def readline(self, *_: object) -> bytes:
        """An empty string for each in quotes: pickletools takes them for ASCII, and Python 2 wrote latin1."""
        line = super().readline()
        return b"''\n" if line[:1] in (b"'", b'"') and line.endswith(b"\n") else line


def _scan(data: bytes) -> None:
    """Raise ValueError for lengths beyond the data's end, and for numbers of operations beyond the limits."""
    tuples = 0
    for number, (operation, argument, _) in enumerate(pickletools.genops(_Scanned(data))):
        tuples += operation.name.startswith("TUPLE")
        if number >= MOST_OPERATIONS or tuples > MOST_TUPLES:
            raise ValueError("it has more operations than arrays need")
        if operation.name in ("PUT", "BINPUT", "LONG_BINPUT") and int(argument or 0) >= MOST_OPERATIONS:
            raise ValueError(f"it remembers a value as number {argument!s:.20}")


def read_pickle(file: FileContent) -> dict[str, object]:
    """Return the top-level dictionary of an SMPL pickle; convert values to arrays with `as_array`.

    Raises:
        FileError: as `load_restricted`, or it does not hold a dictionary.
    """
    content = load_restricted(file.content, file.path)
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        kind = type(content).__name__
        raise FileError(file, f"holds no dictionary of named arrays but a {kind}", "use a body model in SMPL's format")
    return content


def load_restricted(data: bytes, path: str | Path) -> object:
    """Load a pickle, the content of the file `path`, with inert records in place of objects.

    Raises:
        FileError: it names a global outside the list above, is not a pickle, is truncated, or exceeds MOST_OPERATIONS
            or MOST_TUPLES.
    """
    try:
        _scan(data)
        return _Unpickler(data, path).load()
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
