"""How many volumes cover a point: Cycles evaluates at most 31 of them and drops the others without a word."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CYCLES_LIMIT = 31
_PADDED = 1.0 + 2.0 / 7.0
"""Half side of the padded box in half extents; Cycles counts the padded one."""


def most_overlapping(position: NDArray, rotation: NDArray, half_extent: NDArray) -> int:
    """The largest number of boxes [K] covering one point, tried at 27 points of each."""
    half = np.asarray(half_extent) * _PADDED
    radius = np.linalg.norm(half, axis=-1)
    lattice = np.stack(np.meshgrid(*[[-0.8, 0.0, 0.8]] * 3, indexing="ij"), -1).reshape(-1, 3)
    most = 0
    for k in range(len(position)):
        near = np.flatnonzero(np.linalg.norm(position - position[k], axis=-1) < radius + radius[k])
        points = position[k] + (lattice * half[k]) @ rotation[k].T
        local = np.einsum("npi,nij->npj", points[None] - position[near, None], rotation[near]) / half[near, None]
        most = max(most, int((np.abs(local) < 1).all(-1).sum(0).max()))
    return most
