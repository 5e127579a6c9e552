"""Safetensors files in a Python without that library: Blender's. The backend reads them by `tensor_file`.

Eight bytes are the length of the header, little-endian; the header is a JSON object; everything after it is data. Each
name of the object is a tensor with `dtype`, `shape` and `data_offsets` (begin and end in the data, bytes), except
`__metadata__`, whose values are strings.
"""

from __future__ import annotations

import dataclasses
import io
import math
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from .json_files import parse_json

LENGTH_BYTES = 8
"""Size of the header's length in a file, and what writers pad the header to a multiple of."""
LARGEST_HEADER = 4 * 2**20
"""Largest length of a header, bytes: names and shapes take many times as much in memory."""
MOST_DIMENSIONS = 8
DTYPES = {
    "F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": "<u2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "|i1",
    "U8": "|u1", "BOOL": "|b1",
}  # fmt: skip
"""numpy's types of the format's dtypes. numpy has no bfloat16: BF16 is read as its bits."""


@dataclasses.dataclass(frozen=True)
class StoredTensor:
    """A tensor's entry in the header."""

    dtype: str
    """The format's name of the type, such as "F32"."""
    shape: tuple[int, ...]
    begin: int
    """Offset of the first byte from the start of the data."""
    end: int


@dataclasses.dataclass(frozen=True)
class TensorLayout:
    """The content of a header."""

    tensors: dict[str, StoredTensor]
    """Tensors in the order of their data, which they cover without holes or overlaps."""
    metadata: dict[str, str]
    data_start: int
    """Offset of the data from the start of the file."""

    def raw(self, file: bytes | memoryview, name: str) -> memoryview:
        """The bytes of a tensor within those of the whole file, without a copy."""
        stored = self.tensors[name]
        return memoryview(file)[self.data_start + stored.begin : self.data_start + stored.end]

    def array(self, file: bytes | memoryview, name: str) -> NDArray:
        """A tensor as a view of the bytes of the whole file, without a copy."""
        stored = self.tensors[name]
        return np.frombuffer(self.raw(file, name), DTYPES[stored.dtype]).reshape(stored.shape)


def read_layout(file: BinaryIO) -> TensorLayout:
    """Read the header of an open file. Raises ValueError, also for a type that is not in DTYPES, and OSError."""
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    length = int.from_bytes(file.read(LENGTH_BYTES), "little")
    if length > LARGEST_HEADER:
        raise ValueError(f"its header is longer than {LARGEST_HEADER / 2**20:.0f} MB")
    header = parse_json(file.read(length))
    if not isinstance(header, dict):
        raise ValueError("its header is not a JSON object")
    metadata = header.pop("__metadata__", None) or {}
    if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
        raise ValueError("its metadata are not strings")
    tensors = {name: _tensor(name, entry) for name, entry in header.items()}
    tensors = dict(sorted(tensors.items(), key=lambda item: (item[1].begin, item[1].end)))
    start = 0
    for name, stored in tensors.items():
        if stored.begin != start:
            raise ValueError(f"{name!r:.40} overlaps another tensor, or bytes before it belong to none")
        start = stored.end
    if start != size - LENGTH_BYTES - length:
        raise ValueError(f"it holds {size - LENGTH_BYTES - length} bytes of data, its header describes {start}")
    return TensorLayout(tensors, metadata, LENGTH_BYTES + length)


def _tensor(name: str, entry: Any) -> StoredTensor:
    try:
        dtype, shape, (begin, end) = entry["dtype"], entry["shape"], entry["data_offsets"]
        size = np.dtype(DTYPES[dtype]).itemsize
        if not all(type(number) is int and 0 <= number < 2**60 for number in (begin, end, *shape)):
            raise ValueError("its numbers are not sizes")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{name!r:.40} has no type, shape or place that can be read ({error!s:.40})") from error
    sides = math.prod(side for side in shape if side)  # numpy multiplies them, also if one is 0
    if len(shape) > MOST_DIMENSIONS or sides >= 2**60 or math.prod(shape) * size != end - begin:
        raise ValueError(f"{name!r:.40} has another size than its shape")
    return StoredTensor(dtype, tuple(shape), begin, end)
