"""Rotation matrices, column vectors: from and to other representations, checks of those in files, and which axis is up.

Conversions take any batch shape, and radians. A person stands whose head is above the hips, and hips above the feet.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..joints import JOINT_NAMES
from .skeleton import REST_JOINTS

TOLERANCE = 1e-3
"""Largest difference of a scalar product of two columns from that of a rotation."""
ROTATION = f"a rotation (orthonormal within {TOLERANCE:g}, determinant 1)"
_COMMON_JOINTS = 22
"""Joints that have the same names in SMPL, SMPL-H and SMPL-X."""
_BLOCK = 100_000
"""Rotations made at once: each step below takes as much memory as its result."""


def from_axis_angle(vector: NDArray) -> NDArray[np.float64]:
    """Rotations [..., 3, 3] of axis-angle vectors [..., 3] (Rodrigues)."""
    vector = np.asarray(vector, np.float64)
    if vector.size <= 3 * _BLOCK:
        return _rodrigues(vector)
    flat = vector.reshape(-1, 3)
    rotation = np.empty((len(flat), 3, 3))
    for first in range(0, len(flat), _BLOCK):
        rotation[first : first + _BLOCK] = _rodrigues(flat[first : first + _BLOCK])
    return rotation.reshape(*vector.shape[:-1], 3, 3)


def _rodrigues(vector: NDArray) -> NDArray[np.float64]:
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    cross = _cross(vector)
    # sin(x)/x and (1 - cos(x))/x^2 by sinc, which is right at 0
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + first * cross + second * (cross @ cross)


def to_axis_angle(rotation: NDArray) -> NDArray[np.float64]:
    """Axis-angle vectors [..., 3], of angles up to pi, of rotations [..., 3, 3]."""
    quaternion = matrix_to_quaternion(rotation)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternion[..., :1])
    return quaternion[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def matrix_to_quaternion(rotation: NDArray) -> NDArray[np.float64]:
    """Unit quaternions [..., 4] of rotations [..., 3, 3], w >= 0.

    Of the four products 4 q_i q the one with the largest q_i is taken, so no half turn divides by zero.
    """
    r = np.asarray(rotation, np.float64)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    wx, wy, wz = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    products = np.stack(
        [
            np.stack([1 + xx + yy + zz, wx, wy, wz], -1),
            np.stack([wx, 1 + xx - yy - zz, xy, xz], -1),
            np.stack([wy, xy, 1 - xx + yy - zz, yz], -1),
            np.stack([wz, xz, yz, 1 - xx - yy + zz], -1),
        ],
        -2,
    )
    largest = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), -1)
    best: NDArray[np.float64] = np.take_along_axis(products, largest[..., None, None], -2)[..., 0, :]
    best = best / np.linalg.norm(best, axis=-1, keepdims=True)
    return best * np.where(best[..., :1] < 0, -1.0, 1.0)


def from_quaternion(quaternion: NDArray) -> NDArray[np.float64]:
    """Rotations [..., 3, 3] of quaternions [..., 4], w first, of any length but 0."""
    q = np.asarray(quaternion, np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    cross = _cross(q[..., 1:])
    return np.eye(3) + 2 * q[..., :1, None] * cross + 2 * (cross @ cross)


def about_axis(axis: int, angle: NDArray | float) -> NDArray[np.float64]:
    """Rotations [..., 3, 3] by angles [...] about the axis x, y or z (0, 1, 2)."""
    angle = np.asarray(angle, np.float64)
    cosine, sine = np.cos(angle), np.sin(angle)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.zeros((*angle.shape, 3, 3))
    rotation[..., axis, axis] = 1.0
    rotation[..., first, first] = rotation[..., second, second] = cosine
    rotation[..., second, first], rotation[..., first, second] = sine, -sine
    return rotation


def between(start: NDArray, end: NDArray) -> NDArray[np.float64]:
    """The smallest rotation [3, 3] that takes the direction `start` [3] to `end` [3]; neither may be zero."""
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(a, np.eye(3)[int(np.abs(a).argmin())])  # half a turn about any perpendicular axis
        sine = float(np.linalg.norm(axis))
        return from_axis_angle(axis / sine * np.pi)
    return from_axis_angle(axis / sine * np.arctan2(sine, cosine))


def nearest(matrix: NDArray) -> NDArray[np.float64]:
    """The rotations [..., 3, 3] closest to matrices [..., 3, 3] (by the singular values)."""
    left, _, right = np.linalg.svd(np.asarray(matrix, np.float64))
    flip = np.ones((*left.shape[:-2], 3))
    flip[..., 2] = np.sign(np.linalg.det(left @ right))
    return (left * flip[..., None, :]) @ right


def slerp(a: NDArray, b: NDArray, share: NDArray | float) -> NDArray[np.float64]:
    """Unit quaternions [..., 4] between `a` and `b` along the shorter arc (Shoemake 1985); `share` [..., 1]."""
    dot = (a * b).sum(-1, keepdims=True)
    b = np.where(dot < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    first: NDArray[np.float64] = np.where(near, 1 - share, np.sin((1 - share) * angle) / safe)
    second = np.where(near, share, np.sin(share * angle) / safe)
    return first * a + second * b


def _cross(vector: NDArray) -> NDArray[np.float64]:
    x, y, z = np.moveaxis(np.asarray(vector, np.float64), -1, 0)
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*x.shape, 3, 3)


def axis_name(direction: NDArray) -> str:
    """The axis, such as "z" or "-y", nearest to a direction [3]."""
    axis = int(np.abs(direction).argmax())
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def axis_direction(name: str) -> NDArray[np.float64]:
    """The unit vector [3] of an axis such as "z" or "-y"."""
    return np.eye(3)["xyz".index(name[-1])] * (-1 if name[0] == "-" else 1)


def turn_y_up(
    rotations: NDArray, translations: NDArray, up: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Joint rotations [F, 24, 3, 3] and translations [F, 3] of a world in which the direction `up` [3] is up, turned to
    y up.

    A camera's axes, y down and z away, are turned about x: who faces the camera faces +z then.
    Translations as in SMPL's files: relative to a body whose pelvis is at its rest position, not at the origin.
    """
    turn = about_axis(0, np.pi) if up[1] < 1e-9 - 1 else between(up, np.array([0.0, 1.0, 0.0]))
    rotations = np.array(rotations, np.float64)
    rotations[:, 0] = turn @ rotations[:, 0]
    pelvis = REST_JOINTS[0]
    return rotations, (np.asarray(translations) + pelvis) @ turn.T - pelvis


def first_improper(matrices: NDArray) -> tuple[int, int] | None:
    """Return frame and joint of the first of the matrices [F, n, 3, 3] that is not a rotation; None if all are.

    The columns of a rotation are orthonormal within `TOLERANCE`, and its determinant is positive, and so about 1.
    """
    given = np.asarray(matrices, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        gram = np.swapaxes(given, -1, -2) @ given
        orthonormal = (np.abs(gram - np.eye(3)) <= TOLERANCE).all((-1, -2))
        volume = (np.cross(given[..., 0], given[..., 1]) * given[..., 2]).sum(-1)
        proper = orthonormal & (volume > 0)
    if proper.all():
        return None
    frame, joint = np.argwhere(~proper)[0]
    return int(frame), int(joint)


def improper_text(frame: int | str, joint: int | str) -> str:
    """Describe a matrix that is not a rotation, as a part of a sentence."""
    name = JOINT_NAMES[joint] if isinstance(joint, int) and joint < _COMMON_JOINTS else joint
    return f"a matrix for joint {name} in frame {frame} that is not {ROTATION}"


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
    """Straightness of arms and legs, of joints by SMPL's names [F, 3], 0 to 1 [F]: the mean of their ends' distances
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
