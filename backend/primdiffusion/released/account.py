"""Report on each tensor of a released checkpoint, so that none is ignored silently."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

Fate = Literal["imported", "checked", "dropped"]
"""imported: in the new file; checked: validated, then not needed; dropped: not used by design."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """One tensor."""

    key: str
    """Its name in the file."""
    group: str
    """"schedule", "diffusion", or a module of the body decoder."""
    shape: tuple[int, ...]
    fate: Fate
    note: str
    """What it was checked against, its new name, or why it is not used."""


@dataclasses.dataclass(frozen=True)
class Account:
    """All tensors of a file, in file order."""

    entries: tuple[Entry, ...]

    def groups(self) -> list[dict[str, Any]]:
        """Count tensors and values of each group and fate, in file order, with the first note."""
        rows: dict[tuple[str, str], list[Entry]] = collections.defaultdict(list)
        for entry in self.entries:
            rows[entry.group, entry.fate].append(entry)
        return [
            {
                "group": group,
                "fate": fate,
                "tensors": len(entries),
                "values": sum(_count(entry.shape) for entry in entries),
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


def _count(shape: Sequence[int]) -> int:
    total = 1
    for side in shape:
        total *= side
    return total
