"""The one place where the backend's axes (y up, facing +z) become Blender's (z up, facing -y).

Both are right-handed and in metres, so the change is a rotation by a quarter turn about x: the person's left stays +x.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BLENDER_FROM_BACKEND: NDArray[np.float64] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation [3,3]: x_blender = BLENDER_FROM_BACKEND @ x_backend."""


def points_to_blender(points: NDArray) -> NDArray[np.float64]:
    """Positions or displacements [..., 3], y up, to z up."""
    return np.asarray(points, np.float64) @ BLENDER_FROM_BACKEND.T


def frames_to_blender(rotation: NDArray) -> NDArray[np.float64]:
    """Local-to-world rotations [..., 3, 3] of frames: the world turns, the local axes stay."""
    return BLENDER_FROM_BACKEND @ np.asarray(rotation, np.float64)


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
