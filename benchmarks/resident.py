"""Resident memory of this process and its children, and its growth over repeated rounds."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
import psutil

WARM_ROUNDS = 8
"""Bounded caches fill in the first rounds: of the child, of Blender's undo, of the C library."""


def trim() -> None:
    """Return the memory that the C library has freed to the system, so that resident memory is memory in use."""
    release = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if release is not None:
        release(0)


def resident_mb() -> float:
    return psutil.Process().memory_info().rss / 1e6


def children_mb() -> float:
    """Resident memory of all processes below this one, in MB."""
    return sum(child.memory_info().rss for child in psutil.Process().children(recursive=True)) / 1e6


def growth_mb(resident: Sequence[float]) -> float:
    """Difference in MB between the medians of the last and the first third of the rounds after the warm-up."""
    rounds = _after_warming(resident)
    third = max(1, len(rounds) // 3)
    return float(np.median(rounds[-third:]) - np.median(rounds[:third]))


def growth_mb_a_round(resident: Sequence[float]) -> float:
    """Slope in MB per round of the best-fitting line through the rounds after the warm-up."""
    rounds = _after_warming(resident)
    return float(np.polyfit(np.arange(len(rounds)), rounds, 1)[0]) if len(rounds) > 1 else 0.0


def _after_warming(resident: Sequence[float]) -> Sequence[float]:
    return resident[min(WARM_ROUNDS, len(resident) - 2) :]
