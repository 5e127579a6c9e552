"""Legs of the average skeleton that reach for feet on the floor."""

from __future__ import annotations

import dataclasses

import numpy as np
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rotation import about_axis
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS
from numpy.typing import NDArray

X, Y = 0, 1
_LONGEST = 0.9995
"""Longest reach as a share of the leg's length; beyond it, the foot stays behind."""


@dataclasses.dataclass(frozen=True)
class FootTrack:
    """One foot, frame by frame; y up, metres and radians."""

    ankle: NDArray[np.float64]
    """Where the ankle is [F, 3]."""
    pitch: NDArray[np.float64]
    """The sole against the floor [F]: positive with the toes raised, negative with the heel raised."""
    toes: NDArray[np.float64]
    """Bent up against the foot [F]."""
    heading: NDArray[np.float64]
    """About the vertical [F], positive to the person's left."""


def joint(name: str) -> NDArray[np.float64]:
    """Rest position of a joint of the average skeleton [3], metres."""
    return REST_JOINTS[JOINT_NAMES.index(name)]


def reach(rotations: NDArray, translations: NDArray, feet: dict[str, FootTrack]) -> NDArray[np.float64]:
    """Joint rotations [F, 24, 3, 3] with legs that put the feet, `left` and `right`, on their tracks.

    The knee is a hinge about the leg's own x axis, which points to the side of the foot's heading: its angle follows
    from the distance of hip and ankle (law of cosines), the hip's turn from their direction. A straight leg points
    to a foot that is out of reach.
    """
    posed = np.array(rotations, np.float64)
    pelvis = posed[:, 0]
    for side, foot in feet.items():
        hip = REST_JOINTS[0] + translations + (pelvis @ (joint(f"{side}_hip") - REST_JOINTS[0]))
        thigh = joint(f"{side}_knee") - joint(f"{side}_hip")
        shin = joint(f"{side}_ankle") - joint(f"{side}_knee")
        target = foot.ankle - hip
        bent = about_axis(X, _knee(thigh, shin, np.linalg.norm(target, axis=-1)))
        leg = thigh + bent @ shin
        side_ways = about_axis(Y, foot.heading)[..., 0]
        hip_world = _frame(target, side_ways) @ np.swapaxes(_frame(leg, np.array([1.0, 0.0, 0.0])), -1, -2)
        foot_world = about_axis(Y, foot.heading) @ about_axis(X, -foot.pitch)
        posed[:, JOINT_NAMES.index(f"{side}_hip")] = np.swapaxes(pelvis, -1, -2) @ hip_world
        posed[:, JOINT_NAMES.index(f"{side}_knee")] = bent
        posed[:, JOINT_NAMES.index(f"{side}_ankle")] = np.swapaxes(hip_world @ bent, -1, -2) @ foot_world
        posed[:, JOINT_NAMES.index(f"{side}_foot")] = about_axis(X, -foot.toes)
    return posed


def leg_length() -> float:
    """From the hip to the ankle of the average skeleton at rest, metres."""
    knee = np.linalg.norm(joint("left_hip") - joint("left_knee"))
    return float(knee + np.linalg.norm(joint("left_knee") - joint("left_ankle")))


def _knee(thigh: NDArray, shin: NDArray, distance: NDArray) -> NDArray[np.float64]:
    """Angles [F] about x at which |thigh + R(angle) shin| is the distance [F]: a + b cos + c sin = distance^2."""
    a = thigh @ thigh + shin @ shin + 2 * thigh[0] * shin[0]
    b = 2 * (thigh[1] * shin[1] + thigh[2] * shin[2])
    c = 2 * (thigh[2] * shin[1] - thigh[1] * shin[2])
    largest = np.sqrt(a + np.hypot(b, c)) * _LONGEST
    cosine = (np.minimum(distance, largest) ** 2 - a) / np.hypot(b, c)
    return np.arctan2(c, b) + np.arccos(np.clip(cosine, -1.0, 1.0))


def _frame(along: NDArray, side: NDArray) -> NDArray[np.float64]:
    """Rotations [F, 3, 3] whose first column is the direction `along` [F, 3] and whose second is nearest to `side`."""
    first = along / np.linalg.norm(along, axis=-1, keepdims=True)
    second = side - (side * first).sum(-1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], -1)
