"""Rotation matrices to quaternions, many at once; Blender's order, w first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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


def continuous_quaternions(quaternions: NDArray) -> NDArray[np.float64]:
    """The same rotations [F, ..., 4] with signs chosen so that no frame is more than a half turn from the one before.

    Blender interpolates components, and q and -q are far apart.
    """
    dots = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True)
    flips: NDArray[np.float64] = np.where(dots < 0, -1.0, 1.0)
    signs: NDArray[np.float64] = np.concatenate([np.ones_like(quaternions[:1, ..., :1]), np.cumprod(flips, 0)])
    return quaternions * signs
