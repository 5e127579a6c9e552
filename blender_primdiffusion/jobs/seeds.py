"""Seeds that Blender's properties can hold."""

from __future__ import annotations

import random

LARGEST_SEED = 2**31 - 1
"""The backend itself takes seeds up to 2^63 - 1."""


def random_seed() -> int:
    """Any seed, at random."""
    return random.randrange(LARGEST_SEED + 1)


def last_seed(seed: int, count: int) -> int:
    """Of `count` consecutive seeds. Raises ValueError beyond LARGEST_SEED."""
    last = seed + count - 1
    if last > LARGEST_SEED:
        raise ValueError(f"{count} seeds from {seed} on go beyond {LARGEST_SEED}: choose a smaller seed")
    return last
