"""Which axis points up in a file of poses, and how to turn y there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .rotation import between
from .skeleton import REST_JOINTS

_CLEAR = 0.6
"""Least mean cosine between the pelvis' up direction and an axis for that axis to count as up."""


def find_up(pelvis: NDArray) -> str:
    """The axis, such as "z" or "-y", along which pelvises [F, 3, 3] point up on average; "" where none is clear.

    People stand, sit and walk more than they lie, so over a motion the mean is vertical.
    """
    mean = np.asarray(pelvis)[:, :, 1].mean(0)
    return "" if np.abs(mean).max() < _CLEAR else axis_name(mean)


def axis_name(direction: NDArray) -> str:
    """The axis, such as "z" or "-y", nearest to a direction [3]."""
    axis = int(np.abs(direction).argmax())
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def axis_direction(name: str) -> NDArray[np.float64]:
    """The unit vector [3] of an axis such as "z" or "-y"."""
    return np.eye(3)["xyz".index(name[-1])] * (-1 if name[0] == "-" else 1)


def turn_y_up(rotations: NDArray, translations: NDArray, up: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Joint rotations [F, 24, 3, 3] and translations [F, 3] of a world in which `up` is up, turned to y up.

    Translations as in SMPL's files: relative to a body whose pelvis is at its rest position, not at the origin.
    """
    turn = between(axis_direction(up), np.array([0.0, 1.0, 0.0]))
    rotations = np.array(rotations, np.float64)
    rotations[:, 0] = turn @ rotations[:, 0]
    pelvis = REST_JOINTS[0]
    return rotations, (np.asarray(translations) + pelvis) @ turn.T - pelvis
