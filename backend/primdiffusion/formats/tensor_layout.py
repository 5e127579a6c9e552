"""The safetensors format: where a file holds its tensors. Both programs read such files by this module.

Eight bytes are the length of the header, little-endian; the header is a JSON object; everything after it is data. Each
name of the object is a tensor with `dtype`, `shape` and `data_offsets` (begin and end in the data, bytes), except
`__metadata__`, whose values are strings. `parse_layout` accepts what version 0.8 of the safetensors library accepts,
and nothing else; tests/contract/test_tensor_layout.py compares the two. The narrower limits of both programs are in
`check_limits`.
"""

from __future__ import annotations

import collections
import dataclasses
import io
import math
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from .json_files import Pairs, parse_pairs

LENGTH_BYTES = 8
"""Size of the header's length in a file, and what writers pad the header to a multiple of."""
LONGEST_HEADER = 100_000_000
"""Largest length of a header in the format, bytes."""
LARGEST_HEADER = 4 * 2**20
"""Largest length of a header that the programs read, bytes: names and shapes take many times as much in memory."""
MOST_DIMENSIONS = 8
DTYPES = {
    "F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": "<u2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "|i1",
    "U8": "|u1", "BOOL": "|b1",
}  # fmt: skip
"""numpy's types of the dtypes that the programs read. numpy has no bfloat16: BF16 is read as its bits."""
_BITS = {
    "BOOL": 8, "F4": 4, "F6_E2M3": 6, "F6_E3M2": 6, "U8": 8, "I8": 8, "F8_E5M2": 8, "F8_E4M3": 8, "F8_E8M0": 8,
    "F8_E4M3FNUZ": 8, "F8_E5M2FNUZ": 8, "I16": 16, "U16": 16, "F16": 16, "BF16": 16, "I32": 32, "U32": 32, "F32": 32,
    "C64": 64, "F64": 64, "I64": 64, "U64": 64,
}  # fmt: skip
"""Bits of a value of each of the format's dtypes."""
_METADATA = "__metadata__"
_FIELDS = ("dtype", "shape", "data_offsets")
_DEEPEST = 127
"""Levels of nested lists and objects that serde_json parses."""
_WORD = 2**64


@dataclasses.dataclass(frozen=True)
class StoredTensor:
    """What a header says of a tensor."""

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
    """In the order of their data, which they cover without holes or overlaps."""
    metadata: dict[str, str]
    repeated: tuple[str, ...]
    """Names of tensors or metadata that occur more than once in the header; the format reads their last entry."""
    header_bytes: int

    @property
    def data_start(self) -> int:
        """Offset of the data from the start of the file."""
        return LENGTH_BYTES + self.header_bytes

    @property
    def size(self) -> int:
        """Size of the whole file, bytes."""
        return self.data_start + max((stored.end for stored in self.tensors.values()), default=0)

    def raw(self, file: bytes | memoryview, name: str) -> memoryview:
        """The bytes of a tensor within those of the whole file, without a copy."""
        stored = self.tensors[name]
        return memoryview(file)[self.data_start + stored.begin : self.data_start + stored.end]

    def array(self, file: bytes | memoryview, name: str) -> NDArray:
        """A tensor as a view of the bytes of the whole file, without a copy; its dtype must be one of `DTYPES`."""
        stored = self.tensors[name]
        dtype = np.dtype(DTYPES[stored.dtype])
        count = (stored.end - stored.begin) // dtype.itemsize
        return np.frombuffer(file, dtype, count, self.data_start + stored.begin).reshape(stored.shape)


def read_layout(file: BinaryIO, longest: int = LARGEST_HEADER) -> TensorLayout:
    """Read the header of an open file, whose position is the start of the data afterwards.

    Raises ValueError, also for a header of more than `longest` bytes, and OSError.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    length = file.read(LENGTH_BYTES)
    if len(length) < LENGTH_BYTES:
        raise ValueError("it is shorter than the length of a header")
    count = int.from_bytes(length, "little")
    if count > min(longest, LONGEST_HEADER):
        raise ValueError(f"its header is longer than {longest / 2**20:.0f} MB")
    header = file.read(count)
    if len(header) < count:
        raise ValueError("its header is cut short")
    return parse_layout(header, size - LENGTH_BYTES - count)


def parse_layout(header: bytes, data_bytes: int) -> TensorLayout:
    """The layout that a header describes, of a file with so many bytes of data. Raises ValueError."""
    try:
        tree = parse_pairs(header, _DEEPEST)
    except ValueError as error:
        raise ValueError(f"its header is not JSON ({error!s:.80})") from error
    if not isinstance(tree, Pairs):
        raise ValueError("its header is not a JSON object")
    tensors = {name: _tensor(name, value) for name, value in tree if name != _METADATA}
    texts = _metadata([value for name, value in tree if name == _METADATA])
    tensors = dict(sorted(tensors.items(), key=lambda item: (item[1].begin, item[1].end)))
    _check_cover(tensors, data_bytes)
    repeated = (*_repeated(tree), *_repeated(texts))
    return TensorLayout(tensors, dict(texts), repeated, len(header))


def check_limits(layout: TensorLayout) -> None:
    """Check what the programs require beyond the format, and of which the format's own reader knows nothing.

    A name occurs once, dtypes are those of `DTYPES`, and a tensor has no more axes than `MOST_DIMENSIONS` and no more
    values than numpy and torch can address, even if one of its sides is 0. Raises ValueError.
    """
    if layout.repeated:
        raise ValueError(f"it holds {layout.repeated[0]!r:.40} twice")
    for name, stored in layout.tensors.items():
        if stored.dtype not in DTYPES:
            raise ValueError(f"{name!r:.40} is {stored.dtype}, a type that no tensor here has")
        if len(stored.shape) > MOST_DIMENSIONS or math.prod(side for side in stored.shape if side) >= 2**60:
            raise ValueError(f"{name!r:.40} has {len(stored.shape)} axes or sides that no tensor here has")


def _repeated(pairs: Pairs) -> tuple[str, ...]:
    counts = collections.Counter(name for name, _ in pairs)
    return tuple(name for name, count in counts.items() if count > 1)


def _metadata(found: list[Any]) -> Pairs:
    """The metadata, of the values of `__metadata__` in a header."""
    if len(found) > 1:
        raise ValueError("it holds its metadata twice")
    if not found or found[0] is None:
        return Pairs()
    if not isinstance(found[0], Pairs) or not all(isinstance(text, str) for _, text in found[0]):
        raise ValueError("its metadata are not strings")
    return found[0]


def _tensor(name: str, value: Any) -> StoredTensor:
    """A header's entry: an object with the three fields or, as serde also reads records, a list of them in order."""
    if isinstance(value, Pairs):
        known = [(field, content) for field, content in value if field in _FIELDS]
        fields = dict(known)
        complete = len(known) == len(fields) == len(_FIELDS)
    else:
        complete = isinstance(value, list) and len(value) == len(_FIELDS)
        fields = dict(zip(_FIELDS, value, strict=True)) if complete else {}
    if not complete:
        raise ValueError(f"{name!r:.40} lacks a type, shape or place, or has two")
    shape, offsets = fields["shape"], fields["data_offsets"]
    if not (_are_sizes(shape) and _are_sizes(offsets) and len(offsets) == 2):
        raise ValueError(f"{name!r:.40} has no shape or place of whole numbers")
    return StoredTensor(_dtype(name, fields["dtype"]), tuple(shape), *offsets)


def _dtype(name: str, value: Any) -> str:
    """A dtype: its name or, as serde also reads variants, an object of the name and null."""
    if isinstance(value, Pairs) and len(value) == 1 and value[0][1] is None:
        value = value[0][0]
    if not isinstance(value, str) or value not in _BITS:
        raise ValueError(f"{name!r:.40} has the unknown type {value!r:.20}")
    return value


def _are_sizes(values: Any) -> bool:
    return (
        isinstance(values, list)
        and not isinstance(values, Pairs)
        and all(type(value) is int and value >= 0 for value in values)
    )


def _check_cover(tensors: dict[str, StoredTensor], data_bytes: int) -> None:
    """Check that tensors, sorted by their places, cover the data once, and that each has the bytes of its shape."""
    start = 0
    for name, stored in tensors.items():
        if stored.begin != start or stored.end < start:
            raise ValueError(f"{name!r:.40} overlaps another tensor, or bytes before it belong to none")
        start = stored.end
        bits = 1
        for factor in (*stored.shape, _BITS[stored.dtype]):
            bits *= factor
            if bits >= _WORD:
                raise ValueError(f"{name!r:.40} has an impossible shape")
        if bits != 8 * (stored.end - stored.begin):
            raise ValueError(f"{name!r:.40} has another size than its shape")
    if start != data_bytes:
        raise ValueError(f"it holds {data_bytes} bytes of data, its header describes {start}")
