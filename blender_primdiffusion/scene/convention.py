"""The one place where the backend's axes (y up, facing +z) become Blender's (z up, facing -y).

Both systems are right-handed and in metres, so the change is a quarter turn about x: the human's left stays +x.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BLENDER_FROM_BACKEND: NDArray[np.float64] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation [3,3]: x_blender = BLENDER_FROM_BACKEND @ x_backend."""


def points_to_blender(points: NDArray) -> NDArray[np.float64]:
    """Positions or displacements [..., 3], y up, to z up."""
    return np.asarray(points, np.float64) @ BLENDER_FROM_BACKEND.T


def rotations_to_blender(rotation: NDArray) -> NDArray[np.float64]:
    """World-to-world rotations [..., 3, 3], such as SMPL's joint rotations: both sides turn."""
    return BLENDER_FROM_BACKEND @ np.asarray(rotation, np.float64) @ BLENDER_FROM_BACKEND.T


def points_to_backend(points: NDArray) -> NDArray[np.float64]:
    """Positions or displacements [..., 3], z up, to y up."""
    return np.asarray(points, np.float64) @ BLENDER_FROM_BACKEND


def transforms_to_backend(matrices: NDArray) -> NDArray[np.float64]:
    """Affine maps [..., 4, 4] of Blender's space into itself as rows [A | t] [..., 3, 4]: both sides turn."""
    matrices = np.asarray(matrices, np.float64)
    linear = BLENDER_FROM_BACKEND.T @ matrices[..., :3, :3] @ BLENDER_FROM_BACKEND
    return np.concatenate([linear, points_to_backend(matrices[..., :3, 3])[..., None]], -1)


def continuous_quaternions(quaternions: NDArray) -> NDArray[np.float64]:
    """The same rotations [F, ..., 4] with signs chosen so that no frame is more than a half turn from the one before.

    Blender interpolates components, and q and -q are far apart.
    """
    dots = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True)
    flips: NDArray[np.float64] = np.where(dots < 0, -1.0, 1.0)
    signs: NDArray[np.float64] = np.concatenate([np.ones_like(quaternions[:1, ..., :1]), np.cumprod(flips, 0)])
    return quaternions * signs
