"""Read a checkpoint of the authors without executing pickled code, and report on each of its tensors."""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from primdiffusion.files import torch_file

Fate = Literal["imported", "checked", "dropped"]
"""imported: in the new file; checked: validated, then not needed; dropped: not used by design."""
STATE = "model_state_dict"
"""Top-level key of the weights in released checkpoints; the other is "optimizer"."""


@dataclasses.dataclass(frozen=True)
class TensorEntry:
    """One tensor."""

    key: str
    """Name in the file."""
    group: str
    """"schedule", "diffusion", or a module of the body decoder."""
    shape: tuple[int, ...]
    fate: Fate
    note: str
    """Result of its check, its new name, or the reason why it is not used."""


@dataclasses.dataclass(frozen=True)
class Account:
    """All tensors of a file, in file order, so that none is ignored silently."""

    entries: tuple[TensorEntry, ...]

    def groups(self) -> list[dict[str, Any]]:
        """Count tensors and values of each group and fate, in file order, with the first note."""
        rows: dict[tuple[str, str], list[TensorEntry]] = collections.defaultdict(list)
        for entry in self.entries:
            rows[entry.group, entry.fate].append(entry)
        return [
            {
                "group": group,
                "fate": fate,
                "tensors": len(entries),
                "values": sum(math.prod(entry.shape) for entry in entries),
                "note": entries[0].note,
            }
            for (group, fate), entries in rows.items()
        ]

    def table(self) -> str:
        """Format the groups as a text table."""
        rows = [
            (row["group"], row["fate"], str(row["tensors"]), f"{row['values']:,}", row["note"]) for row in self.groups()
        ]
        rows.insert(0, ("group", "fate", "tensors", "values", "note"))
        widths = [max(len(row[column]) for row in rows) for column in range(4)]
        return "\n".join(
            f"{row[0]:<{widths[0]}}  {row[1]:<{widths[1]}}  {row[2]:>{widths[2]}}  {row[3]:>{widths[3]}}  {row[4]}"
            for row in rows
        )


def read_weights(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a released checkpoint in file order, memory-mapped if possible, so optimisers are not loaded.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file would execute code, is truncated, or is not a dictionary of named tensors.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}: give the path of the authors' primdiffusion.pt")
    content = torch_file.load(path)
    state = content.get(STATE, content) if isinstance(content, Mapping) else content
    if not isinstance(state, Mapping):
        raise ValueError(
            f"{path} contains a {type(state).__name__} instead of {STATE!r}: give the authors' primdiffusion.pt"
        )
    for key, value in state.items():
        if not isinstance(key, str) or not isinstance(value, Tensor) or not torch_file.is_plain(value):
            raise ValueError(
                f"{key!r} in {path} is a {type(value).__name__}, not a dense tensor: give the authors' "
                f"primdiffusion.pt, with top-level keys {STATE!r} and 'optimizer'"
            )
    return dict(state)
