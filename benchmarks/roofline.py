"""Measures how fast this processor multiplies and adds: the ceiling for the marcher's samples.

A sample costs about 136 floating-point operations (SPEC 4): 24 for its position, 50 for trilinear weights and indices,
56 for four channels at eight corners, the rest for the window and the sums. The ceiling is what the same compiler
reaches on a polynomial of degree 32 whose arguments are in the first-level cache: two operations per step, no waiting
for memory.
"""

from __future__ import annotations

import time

import numba
import numpy as np

OPERATIONS_PER_SAMPLE = 136
DEGREE = 32
ARGUMENTS = 2048
"""8 KB: they stay in the first-level cache."""
ROUNDS = 2000


@numba.njit(fastmath=True)
def _polynomial(argument, value, rounds):
    factor, term = np.float32(0.999), np.float32(0.001)
    for _ in range(rounds):
        for i in range(len(argument)):
            x, v = argument[i], value[i]
            for _ in range(DEGREE // 4):
                v = v * x + term
                v = v * x + factor
                v = v * x + term
                v = v * x + factor
            value[i] = v


def float32_operations_per_second(repeats: int = 7) -> float:
    """Operations per second of ONE thread, the best of `repeats` runs; a fused multiply-add counts as two."""
    argument = np.linspace(0.1, 0.9, ARGUMENTS, dtype=np.float32)
    value = np.zeros(ARGUMENTS, np.float32)
    _polynomial(argument, value, 1)
    best = np.inf
    for _ in range(repeats):
        began = time.process_time()
        _polynomial(argument, value, ROUNDS)
        best = min(best, time.process_time() - began)
    return 2 * DEGREE * ARGUMENTS * ROUNDS / best


def roofline_ms(samples: int, operations_per_second: float) -> float:
    """Milliseconds for `samples` on one thread at the ceiling."""
    return 1e3 * samples * OPERATIONS_PER_SAMPLE / operations_per_second
