"""What became of everybody in a batch, on disk while it goes on."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from ..formats.capture_layout import replacing


@dataclasses.dataclass
class Report:
    """Grows while a batch is rendered."""

    done: list[str] = dataclasses.field(default_factory=list)
    """Subjects that were finished now."""
    failed: list[dict[str, str]] = dataclasses.field(default_factory=list)
    """Of each failure: subject (empty where it was none's), what was tried, and why it did not succeed."""
    skipped: list[str] = dataclasses.field(default_factory=list)
    """Subjects that were finished before."""
    notes: list[str] = dataclasses.field(default_factory=list)
    """What was found out about scans and poses, a sentence each."""

    def fail(self, subject: str, what: str, why: str) -> str:
        """Note a failure; returns it as one line."""
        why = " ".join(why.split())
        self.failed.append({"subject": subject, "what": what, "why": why})
        return f"{subject or what}: {why}"

    def write(self, root: Path, shard: tuple[int, int]) -> None:
        """To report.json, or report-i-of-n.json of one shard among several."""
        with replacing(report_path(root, shard)) as path:
            path.write_text(json.dumps(dataclasses.asdict(self), indent=1), encoding="utf-8")


def report_path(root: Path, shard: tuple[int, int]) -> Path:
    """Where the report of a shard lies."""
    return root / ("report.json" if shard[1] == 1 else f"report-{shard[0]}-of-{shard[1]}.json")
