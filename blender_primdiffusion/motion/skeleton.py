"""The average skeleton: its joints at rest, where they are in a pose, and legs that reach for feet."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES, PARENTS
from .rotation import about_axis

_LEFT = {
    "hip": (0.114, -0.236, 0.011), "knee": (0.139, -0.643, 0.019), "ankle": (0.139, -1.089, -0.007),
    "foot": (0.151, -1.141, 0.140), "collar": (0.024, 0.259, 0.038), "shoulder": (0.181, 0.254, 0.032),
    "elbow": (0.450, 0.254, 0.032), "wrist": (0.690, 0.250, 0.042), "hand": (0.794, 0.250, 0.042),
}  # fmt: skip
_MIDDLE = {
    "pelvis": (0.0, -0.220, 0.020), "spine1": (0.0, -0.137, -0.019), "spine2": (0.0, -0.066, -0.005),
    "spine3": (0.0, 0.017, -0.009), "neck": (0.0, 0.337, 0.022), "head": (0.0, 0.436, 0.055),
}  # fmt: skip


def _place(name: str) -> tuple[float, float, float]:
    if name in _MIDDLE:
        return _MIDDLE[name]
    side, _, part = name.partition("_")
    x, y, z = _LEFT[part]
    return (x if side == "left" else -x, y, z)


REST_JOINTS: NDArray[np.float64] = np.array([_place(name) for name in JOINT_NAMES])
"""Joints [24, 3] of the default body's mean person, metres, y up, facing +z, its left at +x; whole millimetres."""
FLOOR = -1.168
"""Height of the soles at rest, metres."""
HEIGHT = 1.76
"""Body height, metres."""
X, Y = 0, 1
_LONGEST = 0.9995
"""Longest reach as a share of the leg's length; beyond it, the foot stays behind."""


def chain(rotations: NDArray) -> NDArray[np.float64]:
    """Joint rotations [..., 24, 3, 3] relative to the parents, as rotations in the world."""
    world = np.array(rotations, np.float64)
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            world[..., joint, :, :] = world[..., parent, :, :] @ rotations[..., joint, :, :]
    return world


def unchain(world: NDArray) -> NDArray[np.float64]:
    """The inverse of `chain`: rotations in the world [..., 24, 3, 3], relative to the parents."""
    relative = np.array(world, np.float64)
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            relative[..., joint, :, :] = np.swapaxes(world[..., parent, :, :], -1, -2) @ world[..., joint, :, :]
    return relative


def joint_positions(
    rotations: NDArray, translations: NDArray | None = None, rest: NDArray = REST_JOINTS
) -> NDArray[np.float64]:
    """Joints [..., 24, 3], metres, of a skeleton at rest [24, 3] under joint rotations [..., 24, 3, 3] (SMPL eq. 4)."""
    world = chain(rotations)
    joints = np.empty((*world.shape[:-2], 3))
    joints[..., 0, :] = rest[0] if translations is None else rest[0] + np.asarray(translations)
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            joints[..., joint, :] = joints[..., parent, :] + world[..., parent, :, :] @ (rest[joint] - rest[parent])
    return joints


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
