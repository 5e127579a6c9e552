"""How many boxes of a human overlap: Cycles evaluates a limited number of volumes at a point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_OFFSET = 0.8
"""Offset from the middle, in half sides, of the points of a box that are tried on each axis."""


def max_overlap(centre: NDArray, rotation: NDArray, half: NDArray) -> int:
    """The largest number of boxes (centre [K, 3], axes in columns [K, 3, 3], half sides [K, 3]) over one point.

    A lower bound: 27 points of each box are tried.
    """
    centre, rotation, half = (np.asarray(values, np.float32) for values in (centre, rotation, half))
    lattice = (
        np.stack(np.meshgrid(*[[-_OFFSET, 0.0, _OFFSET]] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    )
    tried, box = _near(centre, np.linalg.norm(half, axis=-1))
    into = rotation[box].transpose(0, 2, 1)
    at = np.matmul(into, (centre[tried] - centre[box])[..., None])[..., 0] / half[box]
    axes = np.matmul(into, rotation[tried]) * half[tried][:, None] / half[box][..., None]
    meets = (np.abs(at) < 1 + _OFFSET * np.abs(axes).sum(-1)).all(-1)
    tried, at, axes = tried[meets], at[meets], axes[meets]
    inside = np.ones((len(at), len(lattice)), bool)
    for axis in range(3):
        inside &= np.abs(axes[:, axis] @ lattice.T + at[:, axis, None]) < 1
    firsts = np.searchsorted(tried, np.arange(len(centre)))  # each box meets itself
    return int(np.add.reduceat(inside, firsts, axis=0, dtype=np.int32).max())


def _near(centre: NDArray, radius: NDArray) -> tuple[NDArray, NDArray]:
    """Pairs of a box and one, or itself, that may contain one of its points; sorted."""
    squared = np.zeros((len(centre), len(centre)), centre.dtype)
    for axis in range(3):
        squared += (centre[:, None, axis] - centre[None, :, axis]) ** 2
    return np.nonzero(squared < (_OFFSET * radius[:, None] + radius[None]) ** 2)
