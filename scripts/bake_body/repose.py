"""Moves people from MakeHuman's A pose to SMPL's T pose."""

from __future__ import annotations

import numpy as np
from primdiffusion.formats.joints import JOINT_NAMES, PARENTS

PELVIS_AT_REST = np.array([0.0, -0.22, 0.02])
"""Position of the pelvis in SMPL's template, in metres."""
COLLAR_LIFT = np.deg2rad(6)


def rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation from direction a to direction b, which must not be opposite."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    x, y, z = np.cross(a, b)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + k + k @ k / (1 + a @ b)


def t_pose_rotations(joints: np.ndarray) -> np.ndarray:
    """[24, 3, 3] world rotation of each joint: collars raised, arms along x, legs almost vertical, feet unchanged."""
    rotation = np.tile(np.eye(3), (24, 1, 1))
    for side, sign in (("left_", 1), ("right_", -1)):
        j = {name.removeprefix(side): i for i, name in enumerate(JOINT_NAMES) if name.startswith(side)}
        sin, cos = np.sin(COLLAR_LIFT) * sign, np.cos(COLLAR_LIFT)
        rotation[j["collar"]] = [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]
        upper_arm = joints[j["elbow"]] - joints[j["shoulder"]]
        forearm = joints[j["wrist"]] - joints[j["elbow"]]
        hand = joints[j["hand"]] - joints[j["wrist"]]
        outward = np.array([sign, 0.0, 0.0])
        shoulder = rotation_between(upper_arm, outward)
        elbow = rotation_between(shoulder @ forearm, np.array([sign, -0.02, 0.04])) @ shoulder
        wrist = rotation_between(elbow @ hand, outward) @ elbow
        rotation[j["shoulder"]], rotation[j["elbow"]] = shoulder, elbow
        rotation[j["wrist"]] = rotation[j["hand"]] = wrist
        thigh = joints[j["knee"]] - joints[j["hip"]]
        shin = joints[j["ankle"]] - joints[j["knee"]]
        rotation[j["hip"]] = rotation_between(thigh, np.array([sign * 0.06, -1, 0.02]))
        rotation[j["knee"]] = rotation_between(shin, np.array([0, -1, -0.06]))
    return rotation


def _blend(
    weights: np.ndarray, rotation: np.ndarray, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Per vertex, the linear part and the translation of sum_j w_j (R_j (x - start_j) + end_j)."""
    shift = end - np.einsum("jab,jb->ja", rotation, start)
    return (weights @ rotation.reshape(-1, 9)).reshape(-1, 3, 3), weights @ shift


def to_t_pose(vertices: np.ndarray, joints: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One person in T pose, with the pelvis at PELVIS_AT_REST.

    Vertices are the mean of linear blend skinning forwards and the inverse of skinning backwards: the first loses
    volume at the joints, the second gains as much.
    """
    rotation = t_pose_rotations(joints)
    moved = joints.copy()
    for j in range(1, 24):
        moved[j] = moved[PARENTS[j]] + rotation[PARENTS[j]] @ (joints[j] - joints[PARENTS[j]])
    linear, shift = _blend(weights, rotation, joints, moved)
    forwards = np.einsum("vab,vb->va", linear, vertices) + shift
    linear, shift = _blend(weights, rotation.transpose(0, 2, 1), moved, joints)
    backwards = np.linalg.solve(linear, (vertices - shift)[..., None])[..., 0]
    shift = PELVIS_AT_REST - moved[0]
    return (forwards + backwards) / 2 + shift, moved + shift
