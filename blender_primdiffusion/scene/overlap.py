"""How many volumes cover a point: Cycles evaluates at most 31 of them and drops the others without a word."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def most_overlapping(centre: NDArray, rotation: NDArray, half: NDArray) -> int:
    """The largest number of boxes (centre, axes in columns, half sides) over one point; 27 points of each are tried."""
    radius = np.linalg.norm(half, axis=-1)
    lattice = np.stack(np.meshgrid(*[[-0.8, 0.0, 0.8]] * 3, indexing="ij"), -1).reshape(-1, 3)
    most = 0
    for k in range(len(centre)):
        near = np.flatnonzero(np.linalg.norm(centre - centre[k], axis=-1) < radius + radius[k])
        points = centre[k] + (lattice * half[k]) @ rotation[k].T
        local = np.einsum("npi,nij->npj", points[None] - centre[near, None], rotation[near]) / half[near, None]
        most = max(most, int((np.abs(local) < 1).all(-1).sum(0).max()))
    return most
