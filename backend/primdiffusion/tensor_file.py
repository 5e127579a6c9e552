"""Read untrusted safetensors files, and write them: the same tensors and metadata give the same bytes."""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Callable, Container, Mapping
from pathlib import Path
from typing import Any, TypeVar

import safetensors.torch
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from primdiffusion.formats.arrays import LARGEST_NUMBER
from primdiffusion.formats.json_files import parse_json
from primdiffusion.formats.regular_files import open_regular, private_content
from primdiffusion.formats.tensor_layout import LENGTH_BYTES, StoredTensor, TensorLayout, check_limits, read_layout

LARGEST_FILE = 16 * 2**30
_KINDS = {
    "F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16, "I64": torch.int64,
    "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8, "BOOL": torch.bool,
}  # fmt: skip
"""torch's types of the dtypes in `formats.tensor_layout`."""
_MAKERS = {torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn}
_COPIES, _SMALL = 2, 100_000
"""Layers with weight normalisation make their weights twice; networks count and place with small tensors."""
Network = TypeVar("Network", bound=nn.Module)


def read(path: Path, limit: int = LARGEST_FILE) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors and the metadata of a file of at most `limit` bytes.

    Raises ValueError, also for numbers that are not finite or above LARGEST_NUMBER; FileError for a larger file,
    FileNotFoundError and other OSErrors.
    """
    file = opened(path, limit)
    return file.finite_tensors(), file.metadata


def read_metadata(path: Path, limit: int = LARGEST_FILE) -> dict[str, str]:
    """Return the metadata without reading tensors. Raises as `read`."""
    with open_regular(path, limit) as file:
        return _layout(file).metadata


def opened(path: Path, limit: int = LARGEST_FILE) -> TensorFile:
    """Open a file for reading parts of its tensors. Raises as `read`."""
    with open_regular(path, limit) as file:
        return TensorFile(file)


class TensorFile:
    """A safetensors file in memory; tensors are views of it, and writing to them leaves the file as it is.

    Everything is read from the file that was opened, also after another one has taken its name; up to COPIED_BYTES also
    after it was overwritten (see `private_content`).
    """

    def __init__(self, file: io.BufferedReader | io.BytesIO) -> None:
        """Check and keep the content of an open file, which may be closed. Raises ValueError, OSError."""
        self._layout = _layout(file)
        self._bytes = private_content(file)
        if len(self._bytes) < self._layout.size:
            raise ValueError("it was cut short while it was read")

    @property
    def metadata(self) -> dict[str, str]:
        """The metadata, empty without any."""
        return self._layout.metadata

    @property
    def tensors(self) -> Mapping[str, StoredTensor]:
        """Type, shape and place of each tensor."""
        return self._layout.tensors

    def tensor(self, name: str) -> Tensor:
        """A tensor of the file, of any values. Raises KeyError."""
        stored = self._layout.tensors[name]
        kind, size = _KINDS[stored.dtype], stored.end - stored.begin
        if size == 0:
            return torch.empty(stored.shape, dtype=kind)
        begin = self._layout.data_start + stored.begin
        values = torch.frombuffer(self._bytes, dtype=torch.uint8, count=size, offset=begin)
        if begin % kind.itemsize:
            values = values.clone()  # kernels may rely on addresses that are multiples of the size
        return values.view(kind).reshape(stored.shape)

    def finite_tensors(self, names: Container[str] | None = None) -> dict[str, Tensor]:
        """All tensors, or those of `names`.

        Raises ValueError for numbers that are not finite or above LARGEST_NUMBER.
        """
        tensors = {name: self.tensor(name) for name in self._layout.tensors if names is None or name in names}
        for name, values in tensors.items():
            if not ((values >= -LARGEST_NUMBER) & (values <= LARGEST_NUMBER)).all():
                raise ValueError(f"{name!r:.60} holds NaN or infinite values, or numbers above {LARGEST_NUMBER:g}")
        return tensors

    def sha256(self) -> str:
        """SHA-256 of the whole file, hexadecimal."""
        return hashlib.sha256(self._bytes).hexdigest()


def _layout(file: io.BufferedReader | io.BytesIO) -> TensorLayout:
    layout = read_layout(file)
    check_limits(layout)
    return layout


def save(tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> bytes:
    """The content of a file, in which the metadata are sorted: safetensors' own writer orders them at random.

    Raises ValueError for tensors that share memory or are not contiguous.
    """
    content = safetensors.torch.save(dict(tensors))
    end = LENGTH_BYTES + int.from_bytes(content[:LENGTH_BYTES], "little")
    entries = parse_json(content[LENGTH_BYTES:end].decode())
    header = {"__metadata__": dict(sorted(metadata.items()))} if metadata else {}
    header |= dict(sorted(entries.items(), key=lambda entry: entry[1]["data_offsets"]))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % LENGTH_BYTES)
    return len(text).to_bytes(LENGTH_BYTES, "little") + text + content[end:]


def load_network(build: Callable[[], Network], tensors: Mapping[str, Tensor]) -> Network:
    """Build a network whose sizes an untrusted file states, and load the file's `tensors` into it.

    Raises RuntimeError where they do not fit, and as `ParameterLimit`; what `build` raises.
    """
    with ParameterLimit(tensors):
        network = build()
    network.load_state_dict(tensors)
    return network


class ParameterLimit(TorchFunctionMode):
    """Within it, making more values than a network with these tensors has raises RuntimeError."""

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        self._left = _COPIES * sum(values.numel() for values in tensors.values()) + _SMALL

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Count the values of a new tensor before it takes memory."""
        kwargs = kwargs or {}
        if func in _MAKERS:
            size = (args or (kwargs["size"],))[0]
            self._left -= math.prod(args if isinstance(size, int) else size)
            if self._left < 0:
                raise RuntimeError("the network has more parameters than the file has values")
        return func(*args, **kwargs)
