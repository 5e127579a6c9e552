"""A walk in place and a wave of the right hand as SMPL joint rotations: a small motion for examples.

Uses only numpy, so that it runs in Blender's Python as well as in the backend's.
"""

from __future__ import annotations

import numpy as np

LEFT_HIP, RIGHT_HIP, LEFT_KNEE, RIGHT_KNEE, LEFT_ANKLE, RIGHT_ANKLE = 1, 2, 4, 5, 7, 8
SPINE, HEAD, LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_ELBOW, RIGHT_ELBOW = 3, 15, 16, 17, 18, 19


def about(axis: str, degrees: np.ndarray) -> np.ndarray:
    """Rotations [F, 3, 3] by angles [F] in degrees about the x, y or z axis of the rest pose (y up, facing z)."""
    angle = np.deg2rad(np.asarray(degrees, dtype=np.float64))
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    rotation = np.zeros((*angle.shape, 3, 3))
    rotation[..., i, i] = 1
    rotation[..., j, j] = rotation[..., k, k] = np.cos(angle)
    rotation[..., k, j] = np.sin(angle)
    rotation[..., j, k] = -np.sin(angle)
    return rotation


def walk_and_wave(frames: int = 48, strides: float = 2.0) -> np.ndarray:
    """Joint rotations [frames, 24, 3, 3]: frame 0 is the rest pose, then the person walks in place and waves.

    Rotations are relative to the parent, about the joint, in the axes of the rest pose, as in SMPL.
    """
    time = np.linspace(0, 1, frames)
    ease = np.clip(time / 0.2, 0, 1)
    ease = ease * ease * (3 - 2 * ease)
    phase = 2 * np.pi * strides * time
    swing = np.sin(phase) * ease
    rotation = np.broadcast_to(np.eye(3), (frames, 24, 3, 3)).copy()

    rotation[:, LEFT_HIP] = about("x", -28 * swing)
    rotation[:, RIGHT_HIP] = about("x", 28 * swing)
    rotation[:, LEFT_KNEE] = about("x", ease * (12 + 32 * np.clip(np.cos(phase), 0, 1)))
    rotation[:, RIGHT_KNEE] = about("x", ease * (12 + 32 * np.clip(-np.cos(phase), 0, 1)))
    rotation[:, LEFT_ANKLE] = about("x", -8 * swing)
    rotation[:, RIGHT_ANKLE] = about("x", 8 * swing)
    rotation[:, SPINE] = about("y", 6 * swing)
    rotation[:, HEAD] = about("y", -6 * swing)
    rotation[:, LEFT_SHOULDER] = about("x", 24 * swing) @ about("z", -68 * ease)
    rotation[:, LEFT_ELBOW] = about("y", -22 * ease)

    raised = about("z", -38 * ease) @ about("x", 0 * time)
    rotation[:, RIGHT_SHOULDER] = raised
    rotation[:, RIGHT_ELBOW] = about("z", ease * (-48 + 22 * np.sin(3 * phase)))
    return rotation
