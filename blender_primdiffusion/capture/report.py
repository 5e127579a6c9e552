"""The report of a batch, written to disk while it runs."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from ..formats.whole_files import write_atomically


@dataclasses.dataclass
class Report:
    """Results of a batch so far."""

    done: list[str] = dataclasses.field(default_factory=list)
    """Subjects that were finished now."""
    failed: list[dict[str, str]] = dataclasses.field(default_factory=list)
    """For each failure: subject (empty for none), what was tried, and why it failed."""
    skipped: list[str] = dataclasses.field(default_factory=list)
    """Subjects that were finished before."""
    notes: list[str] = dataclasses.field(default_factory=list)
    """Notes on scans and poses, a sentence each."""

    def fail(self, subject: str, what: str, why: str) -> str:
        """Note a failure; returns it as one line."""
        why = " ".join(why.split())
        self.failed.append({"subject": subject, "what": what, "why": why})
        return f"{subject or what}: {why}"

    def write(self, root: Path, shard: tuple[int, int]) -> None:
        """To report.json, or report-i-of-n.json of one shard among several."""
        write_atomically(report_path(root, shard), json.dumps(dataclasses.asdict(self), indent=1))


def report_path(root: Path, shard: tuple[int, int]) -> Path:
    """Path of a shard's report."""
    return root / ("report.json" if shard[1] == 1 else f"report-{shard[0]}-of-{shard[1]}.json")
