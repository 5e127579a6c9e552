"""Motion made to fit: other rates, parts of it, kept in place, set on the floor, for longer legs."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..scene.convention import continuous_quaternions, matrix_to_quaternion
from .motion import Motion
from .rotation import from_quaternion
from .skeleton import REST_JOINTS, joint_positions

_FEET = [JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in ("ankle", "foot")]
_STANDING_SHARE = 5.0
"""Percentile of the feet's heights over a motion that counts as the floor: single frames may dip below it."""


def cut(motion: Motion, first: int = 1, last: int = 0, stride: int = 1) -> Motion:
    """Frames `first` to `last` of the file, both included, counted from 1; every `stride`-th. 0 is the last there is.

    Raises ValueError where no frame is left.
    """
    end = len(motion) if last <= 0 else min(last, len(motion))
    if not 1 <= first <= end:
        raise ValueError(f"frames {first} to {last or end} were wanted of {len(motion)}: choose frames that are there")
    if stride < 1:
        raise ValueError(f"every {stride}th frame was wanted: give 1 or more")
    return dataclasses.replace(motion.frames(np.arange(first - 1, end, stride)), fps=motion.fps / stride)


def resample(motion: Motion, fps: float) -> Motion:
    """The same motion at another number of frames a second; rotations go the shortest way (slerp), places straight.

    The last frame is the last whole one within the motion's time.
    """
    if len(motion) < 2 or abs(motion.fps - fps) < 1e-9 * fps:
        return dataclasses.replace(motion, fps=fps)
    seconds = (len(motion) - 1) / motion.fps
    at = np.arange(int(np.floor(seconds * fps + 1e-6)) + 1) / fps * motion.fps
    before = np.minimum(at.astype(np.int64), len(motion) - 2)
    share = np.clip(at - before, 0.0, 1.0)
    turns = continuous_quaternions(matrix_to_quaternion(motion.rotations))
    rotations = from_quaternion(slerp(turns[before], turns[before + 1], share[:, None, None]))
    moved = motion.translations
    places = moved[before] + share[:, None] * (moved[before + 1] - moved[before])
    return dataclasses.replace(motion, rotations=rotations, translations=places, fps=fps)


def slerp(a: NDArray, b: NDArray, share: NDArray | float) -> NDArray[np.float64]:
    """Unit quaternions [..., 4] on the way from `a` to `b`, the shorter one (Shoemake 1985); `share` [..., 1]."""
    dot = (a * b).sum(-1, keepdims=True)
    b = np.where(dot < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    first = np.where(near, 1 - share, np.sin((1 - share) * angle) / safe)
    second = np.where(near, share, np.sin(share * angle) / safe)
    return first * a + second * b


def scale_places(motion: Motion, factor: float) -> Motion:
    """The whole body's path, longer or shorter."""
    return dataclasses.replace(motion, translations=motion.translations * factor)


def in_place(motion: Motion) -> Motion:
    """The person stays over where the skeleton rests; heights are kept."""
    return dataclasses.replace(motion, translations=motion.translations * [0.0, 1.0, 0.0])


def from_origin(motion: Motion) -> Motion:
    """The path begins over where the skeleton rests; heights are kept."""
    start = motion.translations[0] * [1.0, 0.0, 1.0]
    return dataclasses.replace(motion, translations=motion.translations - start)


def on_floor(motion: Motion, rest: NDArray = REST_JOINTS) -> Motion:
    """The whole motion raised or lowered at once, so that its lowest feet are where those of `rest` [24, 3] stand.

    Jumps stay jumps. For somebody who never stands (a swimmer) it means little.
    """
    heights = joint_positions(motion.rotations, motion.translations, rest)[:, _FEET, 1] - rest[_FEET, 1]
    lowest = heights.min(-1)
    floor = float(np.percentile(lowest, _STANDING_SHARE)) if len(lowest) > 1 else float(lowest[0])
    return dataclasses.replace(motion, translations=motion.translations - [0.0, floor, 0.0])


def leg_ratio(rest: NDArray) -> float:
    """How long the legs of a skeleton at rest [24, 3] are, seen against the average one's."""
    return _legs(rest) / _legs(REST_JOINTS)


def _legs(rest: NDArray) -> float:
    ways = (("hip", "knee"), ("knee", "ankle"))
    ends = [(JOINT_NAMES.index(f"{s}_{a}"), JOINT_NAMES.index(f"{s}_{b}")) for s in ("left", "right") for a, b in ways]
    return float(sum(np.linalg.norm(rest[a] - rest[b]) for a, b in ends))
