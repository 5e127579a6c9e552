"""From SMPL's T rest to another rig's rest (an A pose, turned feet, bent elbows): how each part is turned."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES, PARENTS
from .rotation import about_axis, between
from .skeleton import REST_JOINTS

_LIMBS = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist", "wrist": "hand"}
"""Parts whose direction, towards the next, tells how they are turned."""
_SHORTEST = 1e-6


def facing(heads: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Rotation [3, 3] whose columns are the left, the up and the front of a person in the rig's own axes.

    `heads` are the joints' places by SMPL's names. People stand upright at rest, so the nearest axis is up unless it is
    far off, and likewise for a left that is all but an axis. Raises ValueError where the joints lie on a line.
    """
    hips = (heads["left_hip"] + heads["right_hip"]) / 2
    shoulders = (heads["left_shoulder"] + heads["right_shoulder"]) / 2
    ankles = (heads["left_ankle"] + heads["right_ankle"]) / 2
    left = heads["left_hip"] - heads["right_hip"] + heads["left_shoulder"] - heads["right_shoulder"]
    up = (shoulders - hips) + (hips - ankles)
    height = np.linalg.norm(up)
    up = _towards_axis(up / max(float(height), 1e-30), 30.0)
    left = left - up * (left @ up)
    width = np.linalg.norm(left)
    if height < _SHORTEST or width < 1e-3 * height:
        raise ValueError("hips, shoulders and ankles lie on a line: the rest pose is no person's")
    left = _towards_axis(left / width, 5.0)
    left = left - up * (left @ up)
    left /= np.linalg.norm(left)
    return np.stack([left, up, np.cross(left, up)], -1)


def _towards_axis(direction: NDArray, degrees: float) -> NDArray[np.float64]:
    """The nearest axis, where it is within `degrees` of a unit vector [3]; else the vector."""
    axis = np.zeros(3)
    largest = int(np.abs(direction).argmax())
    axis[largest] = np.sign(direction[largest])
    return axis if axis @ direction > np.cos(np.radians(degrees)) else direction


def rig_from_smpl(
    heads: Mapping[str, NDArray], tips: Mapping[str, NDArray], rest: NDArray = REST_JOINTS
) -> NDArray[np.float64]:
    """Rotations [24, 3, 3] that turn each part of a body at SMPL's rest as it is turned at the rig's rest.

    `heads` are the rig's joints at rest by SMPL's names, `tips` where its hands point, both y up and facing +z; `rest`
    [24, 3] are the body's joints. Limbs are turned the shortest way, each going on from its parent, so an arm that
    hangs carries its hand along. Feet stand flat at both rests: they turn about the vertical alone, whatever the shoes.
    The trunk counts as upright at both: spines differ in shape and say nothing of the pose.
    """
    turned = np.tile(np.eye(3), (len(JOINT_NAMES), 1, 1))
    for joint, name in enumerate(JOINT_NAMES):
        side, _, part = name.partition("_")
        parent = PARENTS[joint]
        if part == "ankle":
            turned[joint] = _heading(heads, side, rest)
        elif part and part != "collar":
            turned[joint] = turned[parent]
        target = f"{side}_{_LIMBS[part]}" if part in _LIMBS else ""
        end = heads.get(target, tips.get(name)) if target else None
        if end is None or name not in heads:
            continue
        here = end - heads[name]
        there = turned[joint] @ (rest[JOINT_NAMES.index(target)] - rest[joint])
        if np.linalg.norm(here) > _SHORTEST:
            turned[joint] = between(there, here) @ turned[joint]
    return turned


def _heading(heads: Mapping[str, NDArray], side: str, rest: NDArray) -> NDArray[np.float64]:
    toe = heads.get(f"{side}_foot")
    if toe is None:
        return np.eye(3)
    here = toe - heads[f"{side}_ankle"]
    there = rest[JOINT_NAMES.index(f"{side}_foot")] - rest[JOINT_NAMES.index(f"{side}_ankle")]
    if np.hypot(here[0], here[2]) < 0.2 * np.linalg.norm(here):  # the foot hangs: its heading is not to be seen
        return np.eye(3)
    return about_axis(1, np.arctan2(here[0], here[2]) - np.arctan2(there[0], there[2]))
