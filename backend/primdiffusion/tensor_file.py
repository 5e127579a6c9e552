"""Read untrusted safetensors files, and write them: the same tensors and metadata give the same bytes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from primdiffusion.formats.arrays import LARGEST_NUMBER
from primdiffusion.formats.json_files import parse_json
from primdiffusion.formats.regular_files import open_regular

LARGEST_FILE = 16 * 2**30
LARGEST_HEADER = 4 * 2**20
"""Of names, shapes and metadata, bytes: it takes many times as much in memory."""
MOST_DIMENSIONS = 8
_KINDS = ("F64", "F32", "F16", "BF16", "I64", "I32", "I16", "I8", "U8", "BOOL")
_LENGTH = 8
"""Bytes of the header's length, and what the header is padded to a multiple of."""
_MAKERS = {torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn}
_ROOM, _SMALL = 2, 100_000
"""Layers with weight normalisation make their weights twice; networks count and place with small tensors."""
Network = TypeVar("Network", bound=nn.Module)


class TensorFileError(ValueError):
    """A file that is damaged or no safetensors file. The message is a reason without the file's name."""


def read(path: Path, limit: int = LARGEST_FILE) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors and the metadata of a file of at most `limit` bytes.

    Raises TensorFileError, also for numbers that are not finite or above LARGEST_NUMBER; TooLargeError,
    FileNotFoundError and other OSErrors.
    """
    file = opened(path, limit)
    try:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  no mapping
    except (SafetensorError, RuntimeError) as error:
        raise TensorFileError(str(error)[:120]) from error
    for name, values in tensors.items():
        if not ((values >= -LARGEST_NUMBER) & (values <= LARGEST_NUMBER)).all():
            raise TensorFileError(f"{name!r:.60} holds NaN or infinite values, or numbers above {LARGEST_NUMBER:g}")
    return tensors, file.metadata() or {}


def read_metadata(path: Path, limit: int = LARGEST_FILE) -> dict[str, str]:
    """Return the metadata without reading tensors. Raises as `read`."""
    header = _header(path, limit)
    metadata = header.get("__metadata__") or {}
    if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
        raise TensorFileError("its metadata are no texts")
    return metadata


def opened(path: Path, limit: int = LARGEST_FILE) -> Any:
    """Open a file for reading parts of its tensors (safetensors' `safe_open`). Raises as `read`."""
    for name, about in _header(path, limit).items():
        if name == "__metadata__":
            continue
        kind, shape = (about.get("dtype"), about.get("shape")) if isinstance(about, dict) else (None, None)
        if kind not in _KINDS or not isinstance(shape, list) or len(shape) > MOST_DIMENSIONS:
            raise TensorFileError(f"{name!r:.40} is {kind!s:.20} of a shape or type that no tensor here has")
    try:
        return safe_open(path, framework="pt")
    except (SafetensorError, MemoryError) as error:
        raise TensorFileError(str(error)[:120]) from error


def _header(path: Path, limit: int) -> dict[str, Any]:
    with open_regular(path, limit) as file:
        length = int.from_bytes(file.read(_LENGTH), "little")
        if not 2 <= length <= LARGEST_HEADER:
            raise TensorFileError(f"its header is not one of 2 bytes to {LARGEST_HEADER // 2**20} MB")
        text = file.read(length)
    if len(text) < length:
        raise TensorFileError("its header is cut short")
    header = parse_json(text)
    if not isinstance(header, dict):
        raise TensorFileError("its header is no object of JSON")
    return header


def save(tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> bytes:
    """The content of a file, in which the metadata are sorted: safetensors' own writer orders them at random.

    Raises ValueError for tensors that share memory or are not contiguous.
    """
    content = safetensors.torch.save(dict(tensors))
    end = _LENGTH + int.from_bytes(content[:_LENGTH], "little")
    entries = parse_json(content[_LENGTH:end].decode())
    header = {"__metadata__": dict(sorted(metadata.items()))} if metadata else {}
    header |= dict(sorted(entries.items(), key=lambda entry: entry[1]["data_offsets"]))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % _LENGTH)
    return len(text).to_bytes(_LENGTH, "little") + text + content[end:]


def load_network(build: Callable[[], Network], tensors: Mapping[str, Tensor]) -> Network:
    """Build a network whose sizes an untrusted file states, and load the file's `tensors` into it.

    Raises RuntimeError where they do not fit, and as `RoomFor`; what `build` raises.
    """
    with RoomFor(tensors):
        network = build()
    network.load_state_dict(tensors)
    return network


class RoomFor(TorchFunctionMode):
    """While it is entered, no more values are made than a network with these tensors takes: RuntimeError."""

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        self._room = _ROOM * sum(values.numel() for values in tensors.values()) + _SMALL

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Count the values of a new tensor before it takes memory."""
        kwargs = kwargs or {}
        if func in _MAKERS:
            size = (args or (kwargs["size"],))[0]
            self._room -= math.prod(args if isinstance(size, int) else size)
            if self._room < 0:
                raise RuntimeError("the network has more parameters than the file has values")
        return func(*args, **kwargs)
