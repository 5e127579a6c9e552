"""How long the way of a motion must be for somebody's legs: feet that are on the floor stay where they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from .adjust import leg_ratio
from .motion import Motion
from .skeleton import joint_positions

_SOLES = [JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in ("ankle", "foot")]
_TRAVEL = 0.5
"""Metres of way below which feet tell nothing."""
_STILL = 0.1
"""Metres a second at which a foot is half still."""
_STANDING = 0.5
"""Of the time, how much a foot must stand; feet of skaters, and on treadmills, do not."""
_FACTORS = np.arange(0.6, 1.6001, 0.02)
_FINEST = 0.002
_AS_IT_IS = 0.03
"""Nearer to 1, a motion fits: heels that roll and knees that give are no longer legs."""
_RATE = 25.0
"""Looks a second: from one frame of a fast camera to the next, feet tremble more than they go."""
_MOST_LOOKS = 3000
"""Of longer motions a part tells as much."""


def stride_ratio(motion: Motion, rest: NDArray) -> float | None:
    """The factor on a motion's translations with which feet of the skeleton at rest [24, 3] slide least.

    Of motions whose lengths are an average person's it is the ratio of the legs. Others do not tell whose legs made
    them (AMASS' betas are those of bodies under a licence of their own), but their feet do: while somebody walks an
    ankle or a ball of the foot stands still at any time, if the way is as long as the legs make it. None where the way
    is short or feet stand still at no factor.
    """
    if motion.detected.average_legs:
        return leg_ratio(rest)
    looks = slice(0, None, max(1, round(motion.fps / _RATE)))
    rate = motion.fps / looks.step
    rotations, places = (array[looks][:_MOST_LOOKS] for array in (motion.rotations, motion.translations))
    feet = np.diff(joint_positions(rotations, None, rest)[:, _SOLES], axis=0) * rate
    way = np.diff(places, axis=0)
    if np.linalg.norm(way[:, [0, 2]], axis=-1).sum() < _TRAVEL:
        return None
    way = way[:, None] * rate

    def unrest(factor: float) -> float:
        square = ((feet + factor * way) ** 2).sum(-1).min(-1)
        return float((square / (square + _STILL**2)).mean())

    best = min(_FACTORS, key=unrest)
    near = np.arange(best - _FACTORS[1] + _FACTORS[0], best + _FACTORS[1] - _FACTORS[0], _FINEST)
    best = float(min(near, key=unrest))
    if not _FACTORS[0] < best < _FACTORS[-1] or unrest(best) > 1 - _STANDING:
        return None
    return 1.0 if abs(best - 1) < _AS_IT_IS else best
