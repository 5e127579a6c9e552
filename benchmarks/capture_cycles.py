"""Runs the extension's capture command as a child process and records time and memory at each view."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[1]
MARK = b"PRIMDIFFUSION "


@dataclasses.dataclass(frozen=True)
class Moment:
    wall_s: float
    processor_s: float
    """Processor seconds of the process so far."""
    resident_mb: float


def cycles(people: Path, out: Path, poses: int, cameras: int, size: int, *more: str) -> list[Moment]:
    """Render captures in Cycles under uniform light; one Moment per view.

    Raises:
    RuntimeError: the command failed; contains the end of its output.
    """
    line = [
        sys.executable, "-m", "blender_primdiffusion.capture", "--people", people, "--out", out, "--poses", poses,
        "--cameras", cameras, "--size", size, size, "--progress", "json", *more,
    ]  # fmt: skip
    with subprocess.Popen(list(map(str, line)), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        process, moments = psutil.Process(child.pid), []
        for told in child.stdout:
            if told.startswith(MARK) and child.poll() is None:
                used = process.cpu_times()
                resident = process.memory_info().rss / 1e6
                moments.append(Moment(time.perf_counter(), used.user + used.system, resident))
        words = child.stderr.read().decode(errors="replace")
    if child.returncode:
        raise RuntimeError(f"the capture command ended with {child.returncode}: {words[-2000:]}")
    return moments
