"""Check that matrices of untrusted files are rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .joints import JOINT_NAMES

TOLERANCE = 1e-3
"""Largest difference of a scalar product of two columns from that of a rotation."""
_NAMED = 22
"""Joints that have the same names in SMPL, SMPL-H and SMPL-X."""


def first_improper(matrices: NDArray) -> tuple[int, int] | None:
    """Return frame and joint of the first of the matrices [F, n, 3, 3] that is not a rotation; None if all are.

    The columns of a rotation are orthonormal within `TOLERANCE`, and its determinant is positive, and so about 1.
    """
    given = np.asarray(matrices, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        gram = np.swapaxes(given, -1, -2) @ given
        orthonormal = (np.abs(gram - np.eye(3)) <= TOLERANCE).all((-1, -2))
        volume = (np.cross(given[..., 0], given[..., 1]) * given[..., 2]).sum(-1)
        proper = orthonormal & (volume > 0)
    if proper.all():
        return None
    frame, joint = np.argwhere(~proper)[0]
    return int(frame), int(joint)


def improper_text(frame: int | str, joint: int | str) -> str:
    """Describe a matrix that is not a rotation, as a part of a sentence."""
    name = JOINT_NAMES[joint] if isinstance(joint, int) and joint < _NAMED else joint
    return (
        f"a matrix for joint {name} in frame {frame} that is not a rotation: orthonormal within {TOLERANCE:g}, "
        "determinant 1"
    )
