"""Write safetensors files: the same tensors and metadata give the same bytes."""

from __future__ import annotations

import json
from collections.abc import Mapping

import safetensors.torch
from torch import Tensor

from primdiffusion.formats.json_files import parse_json

_LENGTH = 8
"""Bytes of the header's length, and what the header is padded to a multiple of."""


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
