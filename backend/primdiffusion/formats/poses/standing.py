"""Which axis is up, and which pose is a standing one: heads are above hips, and hips above feet."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..joints import JOINT_NAMES
from .rotation import axis_direction, axis_name

AXES = ("x", "y", "z", "-x", "-y", "-z")
_UPRIGHT = 0.5
"""Least cosine between the vertical and the line from feet to hips, and that from hips to head, of who stands."""
_OFTEN = 0.25
"""Fraction of the frames in which a person stands along the expected axis for it to be kept."""
_PELVIS, _HEAD = JOINT_NAMES.index("pelvis"), JOINT_NAMES.index("head")
_ANKLES = [JOINT_NAMES.index("left_ankle"), JOINT_NAMES.index("right_ankle")]


def find_up(joints: NDArray, expected: str) -> str:
    """The axis along which a person of joints [F, 24, 3] stands in most frames; "" if along none in any frame.

    `expected`, the axis that is up by the file's format, is kept if the person often stands along it: who lies down for
    most of a motion does not turn the world.
    """
    trunk = joints[:, _HEAD] - joints[:, _PELVIS]
    legs = joints[:, _PELVIS] - joints[:, _ANKLES].mean(1)
    axes = np.array([axis_direction(name) for name in AXES])
    standing = ((_unit(trunk) @ axes.T > _UPRIGHT) & (_unit(legs) @ axes.T > _UPRIGHT)).mean(0)
    if standing[AXES.index(expected)] >= _OFTEN:
        return expected
    return AXES[int(standing.argmax())] if standing.any() else ""


def pelvis_up(pelvis: NDArray) -> str:
    """The axis along which pelvises [F, 3, 3] point up on average, for people who stand in no frame."""
    return axis_name(np.asarray(pelvis)[:, :, 1].mean(0))


def is_standing(heads: Mapping[str, NDArray]) -> NDArray[np.bool_]:
    """Whether joints by SMPL's names, places [..., 3], are of a person whose trunk continues the line of the legs."""
    hips, shoulders, ankles = (
        (heads[f"left_{part}"] + heads[f"right_{part}"]) / 2 for part in ("hip", "shoulder", "ankle")
    )
    return (_unit(shoulders - hips) * _unit(hips - ankles)).sum(-1) > _UPRIGHT


def straightness(heads: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """How straight arms and legs are of joints by SMPL's names [F, 3], 0 to 1 [F]: the mean of their ends' distances
    by their lengths."""
    limbs = []
    for side in ("left", "right"):
        for first, middle, last in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")):
            a, b, c = (heads[f"{side}_{part}"] for part in (first, middle, last))
            length = np.linalg.norm(a - b, axis=-1) + np.linalg.norm(b - c, axis=-1)
            limbs.append(np.linalg.norm(a - c, axis=-1) / np.maximum(length, 1e-30))
    return np.mean(limbs, axis=0)


def _unit(vectors: NDArray) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
