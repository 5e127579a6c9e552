"""Read untrusted safetensors files, and write them: the same tensors and metadata give the same bytes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Container, Mapping
from pathlib import Path
from typing import Any, TypeVar

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from primdiffusion.files.arrays import LARGEST_NUMBER
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import open_regular
from primdiffusion.files.tensor_layout import LARGEST_HEADER, LENGTH_BYTES

LARGEST_FILE = 16 * 2**30
"""Largest file of a network or of a training state, bytes."""
_TYPES = (
    torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.int16, torch.int8,
    torch.uint8, torch.bool,
)  # fmt: skip
_TENSOR_FACTORIES = {torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn}
_MOST_COPIES = 2
"""Times that a network makes a parameter: twice in layers with weight normalisation."""
_OTHER_VALUES = 100_000
"""Values of tensors with which a network counts and places."""
Network = TypeVar("Network", bound=nn.Module)


def read(path: Path, limit: int = LARGEST_FILE) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors and the metadata of a file of at most `limit` bytes.

    Raises ValueError, also for numbers that are not finite or above LARGEST_NUMBER; FileError for a larger file,
    FileNotFoundError and other OSErrors.
    """
    file = TensorFile(path, limit)
    return file.finite_tensors(), file.metadata


class TensorFile:
    """An open safetensors file, mapped into memory."""

    def __init__(self, path: Path, limit: int = LARGEST_FILE) -> None:
        """Open a file of at most `limit` bytes. Raises as `read`, but reads no numbers."""
        with open_regular(path, limit) as file:
            if int.from_bytes(file.read(LENGTH_BYTES), "little") > LARGEST_HEADER:
                raise ValueError(f"its header is longer than {LARGEST_HEADER / 2**20:.0f} MB")
        try:
            self._file = safe_open(path, "pt")
        except SafetensorError as error:
            raise ValueError(f"{error!s:.120}") from error
        self.names = sorted(self._file.keys())
        self.metadata: dict[str, str] = self._file.metadata() or {}

    def tensor(self, name: str) -> Tensor:
        """A tensor of any values: a view of the mapped file, which stays as it is when the tensor is written to.

        Raises ValueError for a type that no tensor here has.
        """
        try:
            values = self._file.get_tensor(name)
        except (SafetensorError, RuntimeError, OverflowError, TypeError) as error:
            raise ValueError(f"{name!r:.60} cannot be read: {error!s:.80}") from error
        if values.dtype not in _TYPES:
            raise ValueError(f"{name!r:.60} is {values.dtype}, a type that no tensor here has")
        return values

    def finite_tensors(self, names: Container[str] | None = None) -> dict[str, Tensor]:
        """All tensors, or those of `names`, copied: no program can replace a file on Windows while it is mapped.

        Raises ValueError for numbers that are not finite or above LARGEST_NUMBER.
        """
        tensors = {name: self.tensor(name).clone() for name in self.names if names is None or name in names}
        for name, values in tensors.items():
            if not ((values >= -LARGEST_NUMBER) & (values <= LARGEST_NUMBER)).all():
                raise ValueError(f"{name!r:.60} holds NaN or infinite values, or numbers above {LARGEST_NUMBER:g}")
        return tensors


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
        self._left = _MOST_COPIES * sum(values.numel() for values in tensors.values()) + _OTHER_VALUES

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Count the values of a new tensor before it takes memory."""
        kwargs = kwargs or {}
        if func in _TENSOR_FACTORIES:
            size = (args or (kwargs["size"],))[0]
            self._left -= math.prod(args if isinstance(size, int) else size)
            if self._left < 0:
                raise RuntimeError("the network has more parameters than the file has values")
        return func(*args, **kwargs)


def under(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Select the tensors whose names begin with `prefix`, and remove it."""
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
