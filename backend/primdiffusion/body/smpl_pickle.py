"""Read the pickles in which SMPL is distributed, without executing code from them.

A pickle is a program that may call any importable function. This reader maps every allowed global to one of the inert
records below, which only store their arguments, and rejects all others. `as_array` rebuilds arrays afterwards, so not
even numpy or scipy interprets the file's instructions. Reads files written by Python 2 (latin1 strings), chumpy, and
old and new versions of numpy and scipy; chumpy need not be installed.
"""

from __future__ import annotations

import pathlib
import pickle
import re
import struct
from typing import IO

import numpy as np
import scipy.sparse

MAX_NESTING = 8
"""Limit on nested chumpy selections; body models nest less."""
_NUMBER_TYPE = re.compile(r"[biuf][1248]")


class BodyFileError(ValueError):
    """A file is not a valid body model."""


class UnsafePickleError(BodyFileError):
    """A pickle names a global that a body model does not need."""


class _Stored:
    """Constructor arguments and state of a pickled object."""

    def __init__(self, *arguments: object) -> None:
        self.arguments = arguments
        self.state: object = None

    def __setstate__(self, state: object) -> None:
        self.state = state


class _Array(_Stored):
    """numpy's array: state (version, shape, dtype, column-major, raw bytes)."""


class _BufferArray(_Stored):
    """numpy's array in protocol 5: arguments (raw bytes, dtype, shape, order)."""


class _Scalar(_Stored):
    """numpy's scalar: arguments (dtype, raw bytes)."""


class _NumberType(_Stored):
    """numpy's dtype: argument 0 such as "f8", state 1 the byte order."""


class _Latin1Bytes(_Stored):
    """Bytes written as text by protocol 2: arguments (text, "latin1")."""


class _Chumpy(_Stored):
    """chumpy's array: state["x"]."""


class _ChumpySelection(_Stored):
    """chumpy's indexing of another array: state["a"], ["idxs"], ["preferred_shape"]."""


class _SparseColumns(_Stored):
    """scipy's compressed sparse columns: state["data"], ["indices"], ["indptr"], ["_shape"]."""


class _Reconstructed:
    """copyreg's object constructor of protocols 0 and 1: arguments (class, base, base state)."""

    def __new__(cls, kind: object, *_: object) -> _Stored:  # type: ignore[misc]
        if not (isinstance(kind, type) and issubclass(kind, _Stored)):
            raise UnsafePickleError(
                f"The pickle rebuilds an object of kind {kind!r}; take the file from its publisher again."
            )
        return kind()


_GLOBALS: dict[tuple[str, str], type] = {
    ("numpy", "ndarray"): _Stored,
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
    **{(module, "object"): _Stored for module in ("__builtin__", "builtins")},
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type:
        try:
            return _GLOBALS[module, name]
        except KeyError:
            raise UnsafePickleError(
                f"The pickle asks for the global {module}.{name}, which a body model does not need, so nothing in "
                "it was run; take the file from its publisher again, or convert it to .npz where you trust it."
            ) from None


def read_pickle(path: pathlib.Path) -> dict[str, object]:
    """Return the top-level dictionary of an SMPL pickle; convert values to arrays with `as_array`.

    Raises:
        UnsafePickleError: the pickle names a global outside the list above.
        BodyFileError: it is not a pickle, is truncated, or does not hold a dictionary.
    """
    with open(path, "rb") as file:
        content = load_restricted(file, str(path))
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise BodyFileError(
            f"{path} holds no dictionary of named arrays but a {type(content).__name__}; is it an SMPL file?"
        )
    return content


def load_restricted(file: IO[bytes], name: str) -> object:
    """Load a pickle with inert records in place of objects; `name` identifies it in errors.

    Raises:
        UnsafePickleError: the pickle names a global outside the list above.
        BodyFileError: it is not a pickle, or is truncated.
    """
    try:
        return _Unpickler(file, encoding="latin1").load()
    except UnsafePickleError:
        raise
    except (
        pickle.UnpicklingError, EOFError, TypeError, ValueError, AttributeError, LookupError, RecursionError,
        MemoryError, OverflowError, struct.error,
    ) as error:  # fmt: skip
        raise BodyFileError(f"{name} is not a whole pickle file ({error}); download it again.") from error


def array_of_objects(value: object) -> list[object]:
    """Return the elements of a pickled object array, such as the 0-d array in which `np.save` stores a dictionary.

    Raises:
        ValueError: the value is not an object array.
    """
    match value:
        case _Array(state=(_, tuple(), _NumberType(arguments=("O8" | "O", *_)), _, list() as objects)):
            return objects
    raise ValueError(f"a {type(value).__name__.strip('_')} stands where an array of objects belongs")


def as_array(value: object, nesting: int = 0) -> np.ndarray:
    """Convert a value returned by `read_pickle` to a numeric array; sparse matrices become dense.

    Raises:
        ValueError: the value is not a plain array of numbers, or its parts contradict each other.
    """
    if nesting > MAX_NESTING:
        raise ValueError(
            f"an array is made from arrays nested more than {MAX_NESTING} deep; the file is not a body model"
        )
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
            array = np.asarray(value)
        case _:
            raise ValueError(f"a {type(value).__name__.strip('_')} stands where an array of numbers belongs")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"an array holds {array.dtype} where numbers belong")
    return array


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
    raise ValueError(f"a {type(raw).__name__.strip('_')} stands where an array's bytes belong")


def _dense(data: np.ndarray, indices: np.ndarray, starts: np.ndarray, shape: np.ndarray) -> np.ndarray:
    rows, columns = (int(n) for n in shape)
    if rows * columns > 10**8 or len(starts) != columns + 1:
        raise ValueError(f"a sparse matrix claims {rows} x {columns} entries, which its other parts contradict")
    matrix = scipy.sparse.csc_matrix((data, indices, starts), shape=(rows, columns))
    matrix.check_format(full_check=True)
    return matrix.toarray()
