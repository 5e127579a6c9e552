"""Built-in poses on the floor, and diverse poses picked from motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..formats.poses.built_in import built_in_vectors
from ..formats.poses.motion import Motion
from ..formats.poses.rotation import about_axis, from_axis_angle
from ..formats.poses.skeleton import REST_JOINTS, joint_positions

FLOOR = -1.168
"""Height of the soles at rest, metres."""
_CLEARANCE = REST_JOINTS[:, 1] - FLOOR
_TOUCHING = {"knee": 0.06, "elbow": 0.04, "wrist": 0.03, "hand": 0.03, "pelvis": 0.12, "head": 0.12}
"""Metres from joints to the skin below them; ankles and feet have their rest height."""
_POOL = 1000
"""Number of frames from which poses are picked."""
_NEAR_T_M = 0.08
"""Mean distance of the joints from the first built-in pose up to which a frame counts as near T."""


def built_in_poses(count: int) -> Motion:
    """The first `count` built-in poses, feet on the floor. Raises ValueError where there are fewer."""
    poses = np.array(list(built_in_vectors().values()))
    if not 1 <= count <= len(poses):
        raise ValueError(f"there are 1 to {len(poses)} built-in poses, not {count}: give files for more")
    rotations = from_axis_angle(poses[:count])
    return Motion(rotations, grounding(rotations), 1.0, "built-in")


def grounding(rotations: NDArray) -> NDArray[np.float64]:
    """Vertical translations [F, 3] that put the lowest part of the average body on its floor at rest."""
    joints = joint_positions(rotations)
    clearance = np.array(
        [
            _CLEARANCE[joint] if name.split("_")[-1] in ("ankle", "foot") else _TOUCHING.get(name.split("_")[-1], 0.1)
            for joint, name in enumerate(JOINT_NAMES)
        ]
    )
    down = FLOOR - (joints[..., 1] - clearance).min(-1)
    return np.stack([np.zeros_like(down), down, np.zeros_like(down)], -1)


def pick_poses(motions: Sequence[Motion], count: int, seed: int = 0) -> Motion:
    """`count` poses from the frames of all motions, near-T first, the others as different as possible.

    Each next pose is the one farthest from those picked (farthest-point sampling over joint positions about the pelvis,
    regardless of heading). Where no frame is near a T pose, the built-in one is the first. Poses are put on the floor
    at the origin. The same seed picks the same poses.

    Raises ValueError where the motions have too few frames.
    """
    rotations = np.concatenate([motion.rotations for motion in motions]) if motions else np.zeros((0, 24, 3, 3))
    if len(rotations) < count - 1 or count < 1:
        raise ValueError(
            f"{count} poses cannot be picked from {len(rotations)} frames: give more files, or ask for fewer poses"
        )
    first = built_in_poses(1).rotations
    from_t = _distance(_about_pelvis(rotations), _about_pelvis(first)[0])
    has_t = len(rotations) >= count and from_t.min() < _NEAR_T_M
    if has_t:
        first = rotations[[int(from_t.argmin())]]
    if len(rotations) > _POOL:
        chosen = np.random.default_rng(seed).choice(len(rotations), _POOL, replace=False)
        rotations = rotations[np.sort(chosen)]
    rotations = np.concatenate([first, rotations])
    places, picked = _about_pelvis(rotations), [0]
    distance = _distance(places, places[0])
    while len(picked) < count:
        distance[picked] = -1.0
        picked.append(int(distance.argmax()))
        distance = np.minimum(distance, _distance(places, places[picked[-1]]))
    poses = rotations[picked]
    names = ", ".join(dict.fromkeys(motion.name for motion in motions))
    notes = () if has_t else ("no frame is near a T pose: the first is built in",)
    return Motion(poses, grounding(poses), 1.0, names, notes)


def _about_pelvis(rotations: NDArray) -> NDArray[np.float64]:
    """Joints [F, 24, 3] relative to the pelvis, turned about the vertical to face +z."""
    front = rotations[:, 0, :, 2]
    unturned = np.array(rotations)
    unturned[:, 0] = about_axis(1, -np.arctan2(front[:, 0], front[:, 2])) @ rotations[:, 0]
    return joint_positions(unturned) - REST_JOINTS[0]


def _distance(places: NDArray, place: NDArray) -> NDArray[np.float64]:
    """Mean distance of the joints [F] between poses [F, 24, 3] and one pose [24, 3], metres."""
    return np.linalg.norm(places - place, axis=-1).mean(-1)
