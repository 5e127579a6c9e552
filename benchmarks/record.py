"""What the benchmarks share: command lines, memory, and figures as a flat JSON object with device, versions, commit."""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import dataclasses
import datetime
import importlib.metadata
import json
import math
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import psutil

SAMPLING_S = 0.05
PACKAGES = ("primdiffusion", "torch", "numpy", "numba", "bpy")


def command_line(documentation: str | None) -> argparse.ArgumentParser:
    """A parser with a benchmark's docstring as its help, and the option --json for `report`."""
    parser = argparse.ArgumentParser(description=documentation, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here, flat, with device, versions and commit")
    return parser


def run(main: Callable[[], None], **others: Callable[[], None]) -> None:
    """Calls the one of `others` that the first word of the command line names, or else `main`."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name in others:
        sys.argv = [f"{sys.argv[0]} {name}", *sys.argv[2:]]
    others.get(name, main)()


def write_record(path: str | Path, figures: Mapping[str, float | int | bool | str | None]) -> None:
    """Writes `figures` (None: not measured here) with device, versions, commit and date; writes all or nothing.

    Raises ValueError for a figure that is not finite or has the name of one of those facts: JSON has no NaN, and a
    failed measurement must not be recorded.
    """
    about = surroundings()
    if clash := sorted(set(about) & set(figures)):
        raise ValueError(f"the figure {clash[0]!r} has the name of a fact about the machine: rename it")
    for name, value in figures.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"the figure {name!r} is {value}: measure it again, or record None")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    unfinished.write_text(json.dumps({**figures, **about}, indent=2) + "\n", encoding="utf-8")
    os.replace(unfinished, path)


def report(figures: Mapping[str, float | int | bool | str | None], path: Path | None) -> None:
    """Prints one figure per line; also writes the record if a path is given."""
    if path is not None:
        write_record(path, figures)
    for name, value in figures.items():
        print(name, value)


def surroundings() -> dict[str, str | int | float]:
    """Device, cores, memory, versions, commit ("+" at its end: uncommitted changes) and date of a measurement."""
    facts: dict[str, str | int | float] = {
        "device": device(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "python": platform.python_version(),
        "commit": commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            facts[f"version_{package}"] = importlib.metadata.version(package)
    return facts


def device() -> str:
    """The name of the graphics card that torch uses, otherwise of the processor."""
    with contextlib.suppress(ImportError):  # Blender's environments from 5.2 on have no torch
        import torch

        if torch.cuda.is_available():
            return torch.cuda.get_device_name()
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def commit() -> str:
    """The checkout's commit; "unknown" outside a checkout."""
    here = Path(__file__).parent
    try:
        return subprocess.run(
            ["git", "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty=+"],
            cwd=here,
            capture_output=True,
            text=True,
            check=True,
            encoding="utf-8",
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


@dataclasses.dataclass
class Measurement:
    """Time and memory of a block of code; complete when the block has ended."""

    seconds: float = math.nan
    peak_gb: float = math.nan
    """Largest resident memory of this process and its children during the block, in 10^9 bytes, sampled every 50 ms."""


@contextlib.contextmanager
def measured() -> Iterator[Measurement]:
    """Measures the block: `with measured() as took: ...`, then took.seconds and took.peak_gb."""
    measurement, done = Measurement(), threading.Event()
    highest = _resident()

    def watch() -> None:
        nonlocal highest
        while not done.wait(SAMPLING_S):
            highest = max(highest, _resident())

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    began = time.perf_counter()
    try:
        yield measurement
    finally:
        measurement.seconds = time.perf_counter() - began
        done.set()
        watcher.join()
        measurement.peak_gb = max(highest, _resident()) / 1e9


def _resident() -> int:
    """Resident bytes of this process and its children; a child that ends meanwhile counts as zero."""
    process, total = psutil.Process(), 0
    for member in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            total += member.memory_info().rss
    return total


def trim() -> None:
    """Return the memory that the C library has freed to the system, so that resident memory is memory in use."""
    if sys.platform == "linux":
        release = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc alone
        if release is not None:
            release(0)


def resident_mb() -> float:
    """Resident memory of this process in MB."""
    return psutil.Process().memory_info().rss / 1e6
