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
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor, _weights_only_unpickler

from primdiffusion.formats.arrays import stored_members
from primdiffusion.formats.regular_files import map_privately, open_regular

LARGEST_FILE = 16 * 2**30
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


def load(path: Path) -> object:
    """Return what torch.save wrote. Numbers of files since torch 1.6 stay on disk until they are used.

    The file is opened once, and what is loaded are the bytes whose operations were checked. Raises PICKLE_ERRORS,
    TooLargeError (a ValueError) and OSError.
    """
    with open_regular(path, LARGEST_FILE) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns about pickles that it then rejects
        if file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC:
            return _Archive(file, path).load()
        file.seek(0)
        for _ in range(_LEGACY_PICKLES):
            _check(_Reads(file))
        file.seek(0)
        return torch.load(file, map_location="cpu", weights_only=True)


class _Archive:
    """A zip file of torch.save.

    torch's reader of such archives finds members in another way than Python's: of two with one name, or of two lists of
    names, it may take the other one. So it is not used. Its restricted unpickler gets the pickle that was checked, and
    storages are views of the file that is mapped into memory: they take none for sizes that a pickle only claims.
    """

    def __init__(self, file: io.BufferedReader | io.BytesIO, path: Path) -> None:
        """Find the members. Raises ArrayFileError for an archive that torch.save does not write, OSError."""
        self._members = stored_members(file, path)
        self._bytes = map_privately(file)
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
        unpickler = _weights_only_unpickler.Unpickler(io.BytesIO(content), encoding="utf-8")
        unpickler.persistent_load = self._storage  # type: ignore[assignment]
        return unpickler.load()

    def _content(self, name: str, limit: int) -> bytes:
        member = self._members.get(f"{self._folder}/{name}")
        if member is None or member.size > limit:
            raise pickle.UnpicklingError(f"it holds no {name} of at most {limit} bytes")
        content = bytes(self._bytes[member.begin : member.begin + member.size])
        if len(content) != member.size or zlib.crc32(content) != member.checksum:
            raise pickle.UnpicklingError(f"its {name} is damaged")
        return content

    def _storage(self, saved_id: Any) -> torch.storage.TypedStorage:
        """The storage that a pickle names by ("storage", type, key, location, number of values)."""
        word, storage_type, key, _location, count = saved_id
        dtype = torch.uint8 if storage_type is torch.UntypedStorage else storage_type.dtype
        if word != "storage" or not isinstance(key, str) or type(count) is not int or count < 0:
            raise pickle.UnpicklingError("it names no storage")
        if key not in self._storages:
            member, size = self._members[f"{self._folder}/data/{key}"], count * dtype.itemsize
            if size > member.size:
                raise pickle.UnpicklingError(f"its storage {key:.20} has {member.size} bytes instead of {size}")
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
