"""Memory that is in use: of this process and its children, and how it grows over rounds of the same."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
import psutil

WARM_ROUNDS = 8
"""Caches that end somewhere fill in the first rounds: of the child, of Blender's undo, of the C library."""


def trim() -> None:
    """What the C library keeps of freed memory goes back to the system, so that resident memory is memory in use."""
    release = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if release is not None:
        release(0)


def resident_mb() -> float:
    return psutil.Process().memory_info().rss / 1e6


def children_mb() -> float:
    """Of all processes below this one."""
    return sum(child.memory_info().rss for child in psutil.Process().children(recursive=True)) / 1e6


def growth_mb(resident: Sequence[float]) -> float:
    """From the first third to the last third of the rounds after the warm ones, medians."""
    rounds = _after_warming(resident)
    third = max(1, len(rounds) // 3)
    return float(np.median(rounds[-third:]) - np.median(rounds[:third]))


def growth_mb_a_round(resident: Sequence[float]) -> float:
    """Slope of the straight line that fits the rounds after the warm ones best."""
    rounds = _after_warming(resident)
    return float(np.polyfit(np.arange(len(rounds)), rounds, 1)[0]) if len(rounds) > 1 else 0.0


def _after_warming(resident: Sequence[float]) -> Sequence[float]:
    return resident[min(WARM_ROUNDS, len(resident) - 2) :]
