"""How many volumes cover a point: Cycles evaluates at most 31 of them and drops the others without a word."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_TRIED = 0.8
"""Of half a side: where, beside the middle, points of a box are tried on each axis."""


def most_overlapping(centre: NDArray, rotation: NDArray, half: NDArray) -> int:
    """The largest number of boxes (centre [K, 3], axes in columns [K, 3, 3], half sides [K, 3]) over one point; 27
    points of each are tried."""
    centre, rotation, half = (np.asarray(values, np.float32) for values in (centre, rotation, half))
    lattice = np.stack(np.meshgrid(*[[-_TRIED, 0.0, _TRIED]] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    tried, box = _near(centre, np.linalg.norm(half, axis=-1))
    into = rotation[box].transpose(0, 2, 1)
    at = np.matmul(into, (centre[tried] - centre[box])[..., None])[..., 0] / half[box]
    axes = np.matmul(into, rotation[tried]) * half[tried][:, None] / half[box][..., None]
    meets = (np.abs(at) < 1 + _TRIED * np.abs(axes).sum(-1)).all(-1)
    tried, at, axes = tried[meets], at[meets], axes[meets]
    inside = np.ones((len(at), len(lattice)), bool)
    for axis in range(3):
        inside &= np.abs(axes[:, axis] @ lattice.T + at[:, axis, None]) < 1
    firsts = np.searchsorted(tried, np.arange(len(centre)))  # each box meets itself
    return int(np.add.reduceat(inside, firsts, axis=0, dtype=np.int32).max())


def _near(centre: NDArray, radius: NDArray) -> tuple[NDArray, NDArray]:
    """Pairs of a box and another, or itself, that may hold one of its points; sorted."""
    apart = np.zeros((len(centre), len(centre)), centre.dtype)
    for axis in range(3):
        apart += (centre[:, None, axis] - centre[None, :, axis]) ** 2
    return np.nonzero(apart < (_TRIED * radius[:, None] + radius[None]) ** 2)
