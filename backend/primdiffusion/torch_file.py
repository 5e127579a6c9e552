"""Read untrusted files of torch.save: tensors alone, after a look at the pickle's operations.

`torch.load(weights_only=True)` runs no code, but calls constructors that take any amount of memory: bytearray's.
"""

from __future__ import annotations

import pickle
import pickletools
import struct
import warnings
from pathlib import Path
from typing import BinaryIO

import torch
from torch import Tensor

from primdiffusion.formats.arrays import read_stored_member
from primdiffusion.formats.regular_files import open_regular

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
_LEGACY_PICKLES = 4
"""Before the numbers in files of torch before 1.6: magic number, version, system, content."""
_CALLED = {
    "collections.OrderedDict", "torch.Size", "torch.device", "torch._utils._rebuild_tensor",
    "torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_parameter",
    "torch._utils._rebuild_parameter_with_state",
}  # fmt: skip


def load(path: Path, *, mapped: bool = False) -> object:
    """Return what torch.save wrote; `mapped`: numbers stay on disk where the file's kind permits it.

    Raises PICKLE_ERRORS, TooLargeError (a ValueError) and OSError.
    """
    with open_regular(path, LARGEST_FILE) as file:
        zipped = file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC
        if not zipped:
            file.seek(0)
            for _ in range(_LEGACY_PICKLES):
                _check(_Reads(file))
    if zipped:
        _check(read_stored_member(path, "data.pkl", LARGEST_PICKLE, LARGEST_FILE))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns about pickles that it then rejects
        return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped and zipped)


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
