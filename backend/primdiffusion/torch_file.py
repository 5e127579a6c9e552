"""Read untrusted files of torch.save: tensors alone, after a look at the pickle's operations.

`torch.load(weights_only=True)` runs no code, but calls constructors that take any amount of memory: bytearray's.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import struct
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from primdiffusion.formats.arrays import StoredMember, stored_archive, stored_members
from primdiffusion.formats.regular_files import check_size, open_regular, private_content

try:  # torch's own, but private: another version may lack it
    from torch import _weights_only_unpickler
except ImportError:
    _weights_only_unpickler = None  # type: ignore[assignment]

LARGEST_FILE = 16 * 2**30
LARGEST_COPIED = 4 * 2**30
"""Bytes of a file that is copied into memory before it is loaded: of torch before 1.6, or where torch has no
`_weights_only_unpickler`."""
MOST_OPERATIONS = 500_000
"""Of a pickle; a state dict has some thirty a tensor."""
LARGEST_PICKLE = 64 * 2**20
PICKLE_ERRORS = (
    pickle.UnpicklingError, RuntimeError, EOFError, ValueError, TypeError, LookupError, AttributeError, OverflowError,
    MemoryError, NotImplementedError, AssertionError, OSError, struct.error,
)  # fmt: skip
"""What damaged or hostile files raise: torch's restricted unpickler has no exception class of its own."""
_ZIP_MAGIC = b"PK\x03\x04"
_LEGACY_PICKLES = 5
"""Before the numbers in files of torch before 1.6: magic number, version, system, content, keys of storages."""
_CALLED = {
    "collections.OrderedDict", "torch.Size", "torch.device", "torch._utils._rebuild_tensor",
    "torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_parameter",
    "torch._utils._rebuild_parameter_with_state",
}  # fmt: skip
_CONSTANTS = {
    "GLOBAL", "BINUNICODE", "SHORT_BINUNICODE", "UNICODE", "BININT", "BININT1", "BININT2", "INT", "LONG", "LONG1",
}  # fmt: skip
_PUTS, _GETS = ("BINPUT", "LONG_BINPUT"), ("BINGET", "LONG_BINGET")
_UNKNOWN = object()


def load(path: Path) -> object:
    """Return what torch.save wrote. Numbers of large files since torch 1.6 stay on disk until they are used.

    The file is opened once, and what is loaded are the bytes whose operations were checked. Raises PICKLE_ERRORS,
    FileError and OSError.
    """
    with open_regular(path, LARGEST_FILE) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns about pickles that it then rejects
        if file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC:
            return _Archive(file, path).load()
        check_size(path, file.seek(0, io.SEEK_END), LARGEST_COPIED)
        file.seek(0)
        content = io.BytesIO(file.read())
        for _ in range(_LEGACY_PICKLES):
            _check(_Reads(content))
        content.seek(0)
        return torch.load(content, map_location="cpu", weights_only=True)


class _Archive:
    """A zip file of torch.save.

    torch's reader of such archives finds members in another way than Python's: of two with one name, or of two lists of
    names, it may take the other one. So it does not get the file. torch's restricted unpickler gets the pickle that was
    checked, and storages are views of the file's content: they take no memory for sizes that a pickle only claims.
    Where torch has no such unpickler, torch.load gets an archive that is made anew of the members that were checked.
    """

    def __init__(self, file: io.BufferedReader | io.BytesIO, path: Path) -> None:
        """Find the members. Raises FileError for an archive that torch.save does not write, OSError."""
        self._path = path
        self._members = stored_members(file, path)
        self._bytes = private_content(file)
        self._folder = next(iter(self._members), "").partition("/")[0]
        self._storages: dict[str, torch.storage.TypedStorage] = {}
        if any(not name.startswith(f"{self._folder}/") for name in self._members):
            raise pickle.UnpicklingError("its members are not in one folder, as torch.save writes them")
        if f"{self._folder}/constants.pkl" in self._members:
            raise pickle.UnpicklingError("it is a TorchScript archive, which holds a program")
        if f"{self._folder}/byteorder" in self._members and self._content("byteorder", 16) != b"little":
            raise pickle.UnpicklingError("its numbers are not little-endian")

    def load(self) -> object:
        """Return what was saved. Raises PICKLE_ERRORS."""
        content = self._content("data.pkl", LARGEST_PICKLE)
        _check(content)
        unpickler = _restricted_unpickler(content)
        if unpickler is None:
            return self._load_copy(content)
        unpickler.persistent_load = self._storage
        return unpickler.load()

    def _load_copy(self, content: bytes) -> object:
        """Load a copy of the members that belong to the pickle `content`. Raises PICKLE_ERRORS, FileError."""
        members: dict[str, bytes | memoryview] = {"data.pkl": content, "byteorder": b"little", "version": b"3\n"}
        for saved_id in _storage_ids(content):
            key, member, _ = self._stored(saved_id)
            members[f"data/{key}"] = memoryview(self._bytes)[member.begin : member.begin + member.size]
        check_size(self._path, sum(map(len, members.values())), LARGEST_COPIED)
        copy = stored_archive((f"archive/{name}", value) for name, value in members.items())
        return torch.load(copy, map_location="cpu", weights_only=True)

    def _content(self, name: str, limit: int) -> bytes:
        member = self._members.get(f"{self._folder}/{name}")
        if member is None or member.size > limit:
            raise pickle.UnpicklingError(f"it holds no {name} of at most {limit} bytes")
        content = bytes(self._bytes[member.begin : member.begin + member.size])
        if len(content) != member.size or zlib.crc32(content) != member.checksum:
            raise pickle.UnpicklingError(f"its {name} is damaged")
        return content

    def _stored(self, saved_id: Any) -> tuple[str, StoredMember, torch.dtype]:
        """Key, member and type of the storage that a pickle names by ("storage", type, key, location, count), where the
        member has that many values. Raises PICKLE_ERRORS."""
        word, storage_type, key, _location, count = saved_id
        dtype = torch.uint8 if storage_type is torch.UntypedStorage else storage_type.dtype
        if word != "storage" or not isinstance(key, str) or type(count) is not int or count < 0:
            raise pickle.UnpicklingError("it names no storage")
        member, size = self._members[f"{self._folder}/data/{key}"], count * dtype.itemsize
        if size > member.size:
            raise pickle.UnpicklingError(f"its storage {key:.20} has {member.size} bytes instead of {size}")
        return key, member, dtype

    def _storage(self, saved_id: Any) -> torch.storage.TypedStorage:
        """The storage that a pickle names, as in `_stored`."""
        key, member, dtype = self._stored(saved_id)
        if key not in self._storages:
            size = saved_id[-1] * dtype.itemsize
            self._storages[key] = torch.storage.TypedStorage(
                wrap_storage=self._view(member.begin, size, dtype.itemsize), dtype=dtype, _internal=True
            )
        return self._storages[key]

    def _view(self, begin: int, size: int, alignment: int) -> torch.UntypedStorage:
        if size == 0:
            return torch.UntypedStorage(0)
        values = torch.frombuffer(self._bytes, dtype=torch.uint8, count=size, offset=begin)
        if begin % alignment:
            values = values.clone()  # kernels may rely on addresses that are multiples of the size
        return values.untyped_storage()


def _restricted_unpickler(content: bytes) -> Any:
    """torch's restricted unpickler of a pickle; None where this torch has none of the form that is used here."""
    if _weights_only_unpickler is None:
        return None
    try:
        unpickler = _weights_only_unpickler.Unpickler(io.BytesIO(content), encoding="utf-8")
        torch.storage.TypedStorage(wrap_storage=torch.UntypedStorage(0), dtype=torch.uint8, _internal=True)
    except (AttributeError, TypeError, RuntimeError):
        return None
    return unpickler if hasattr(unpickler, "load") else None


def _storage_ids(content: bytes) -> Iterator[tuple[Any, ...]]:
    """Yield what a pickle names its storages by, in order and without running it.

    torch.save writes each as a tuple of constants right before the operation that uses it. Raises UnpicklingError where
    one is not written so.
    """
    memo: dict[int, object] = {}
    parts: list[object] | None = None  # constants since the last mark
    made: tuple[object, ...] | None = None
    last: object = _UNKNOWN
    for operation, argument, _ in pickletools.genops(content):
        name = operation.name
        if name in _PUTS:
            memo[int(argument)] = last  # type: ignore[arg-type]
            continue
        if name == "BINPERSID" or name == "PERSID":
            if name == "PERSID" or made is None or len(made) != 5 or _UNKNOWN in made:
                raise pickle.UnpicklingError("it names a storage in another way than torch.save")
            yield (made[0], _storage_type(made[1]), *made[2:])
        constant = (str(argument) if name == "GLOBAL" else argument) if name in _CONSTANTS else _UNKNOWN
        last = memo.get(int(argument), _UNKNOWN) if name in _GETS else constant  # type: ignore[arg-type]
        made = tuple(parts) if name == "TUPLE" and parts is not None else None
        if name == "MARK":
            parts = []
        elif parts is not None and (name in _CONSTANTS or name in _GETS):
            parts.append(last)
        else:
            parts = None


def _storage_type(named: object) -> Any:
    module, _, name = str(named).partition(" ")
    found = getattr(torch, name, None) if module in ("torch", "torch.storage") and name.endswith("Storage") else None
    if found is None:
        raise pickle.UnpicklingError(f"{str(named)!r:.60} is no type of storages")
    return found


def is_plain(value: Tensor) -> bool:
    """Whether a tensor is one of numbers in memory: not sparse, nested, quantised or without content."""
    return value.layout == torch.strided and not (value.is_nested or value.is_quantized or value.is_meta)


def _check(source: bytes | _Reads) -> None:
    for number, (operation, argument, _) in enumerate(pickletools.genops(source)):  # type: ignore[arg-type]
        if number >= MOST_OPERATIONS:
            raise pickle.UnpicklingError(f"more than {MOST_OPERATIONS} operations")
        if operation.name in ("GLOBAL", "STACK_GLOBAL", "INST"):
            name = str(argument).replace(" ", ".")
            if name not in _CALLED and not _is_inert(name):
                raise pickle.UnpicklingError(f"GLOBAL {name:.80}")


def _is_inert(name: str) -> bool:
    """Whether it names a type of numbers, or of storages, which torch reads as one."""
    module, _, last = name.rpartition(".")
    return module in ("torch", "torch.storage") and (
        last.endswith("Storage") or isinstance(getattr(torch, last, None), torch.dtype)
    )


class _Reads:
    """A file whose single reads are limited: operations say how many bytes they take."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def read(self, size: int) -> bytes:
        return self._file.read(min(size, LARGEST_PICKLE))

    def readline(self) -> bytes:
        return self._file.readline(LARGEST_PICKLE)
