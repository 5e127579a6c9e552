"""Runs the stages of a benchmark in their own processes; measures wall seconds and peak memory of each process tree."""

from __future__ import annotations

import dataclasses
import subprocess
from collections.abc import Sequence
from pathlib import Path

from record import Measurement, measured


@dataclasses.dataclass(frozen=True)
class Stage:
    """A finished stage, its time and memory."""

    name: str
    took: Measurement


class StageFailed(RuntimeError):
    """A stage ended with a non-zero exit code."""


def run_stage(name: str, command: Sequence[str | Path], log: Path) -> Stage:
    """Runs `command` with its output in `log`; raises StageFailed with the end of that output if it fails."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as output, measured() as took:
        code = subprocess.run([str(part) for part in command], stdout=output, stderr=subprocess.STDOUT).returncode
    if code != 0:
        tail = "\n".join(log.read_text(errors="replace").splitlines()[-25:])
        raise StageFailed(f"{name} ended with exit code {code}; the whole output is in {log}:\n{tail}")
    return Stage(name, took)


def table(rows: Sequence[Stage]) -> str:
    """Seconds and peak memory of each stage, with the sum and the maximum in the last row."""
    width = max(len(row.name) for row in rows)
    lines = [f"{'stage':<{width}}  {'seconds':>8}  {'peak GB':>8}"]
    lines += [f"{row.name:<{width}}  {row.took.seconds:8.1f}  {row.took.peak_gb:8.2f}" for row in rows]
    total, peak = sum(row.took.seconds for row in rows), max(row.took.peak_gb for row in rows)
    return "\n".join([*lines, f"{'total':<{width}}  {total:8.1f}  {peak:8.2f}"])
