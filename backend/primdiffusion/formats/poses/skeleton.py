"""The average skeleton: its joints at rest, and where they are in a pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..joints import JOINT_NAMES, PARENTS

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
