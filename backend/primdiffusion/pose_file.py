"""Pose files: 72 axis-angle numbers (24 joints x 3, radians, SMPL's order, the pelvis first)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from primdiffusion.body.model import BodyPose, J
from primdiffusion.formats.arrays import read_arrays
from primdiffusion.formats.json_files import read_json

POSE_KEYS = ("pose", "poses", "theta")
TRANSLATION_KEYS = ("translation", "trans", "transl")
BODY_NUMBERS = 66
"""Axis-angle numbers of the 22 joints before the hands, the same in SMPL, SMPL-H and SMPL-X."""


LARGEST_NUMBER = 1e6
"""Radians and metres in a pose: larger angles have no digits left after the point in float32."""


def read_pose(path: str | Path, frame: int = 0) -> BodyPose:
    """Read the pose of a .json or .npz file, or one `frame` of several (AMASS: `poses` [F, 156], `trans`).

    JSON: a list of 72 numbers or 24 rows of 3, or an object with such a "pose" and a "translation" in metres.
    SMPL-H and SMPL-X give 22 joints (`body_theta`).

    Raises FileNotFoundError and ValueError.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no pose file {path}: check the path")
    try:
        if path.suffix == ".json":
            content: Any = read_json(path)
        else:
            content = read_arrays(path, optional=(*POSE_KEYS, *TRANSLATION_KEYS))
    except (ValueError, OSError) as e:
        reason = str(e).removeprefix(f"{path}")[:120].strip(" :")
        raise ValueError(
            f"{path} is neither JSON nor an npz of plain arrays ({reason}): convert it to one of these"
        ) from e
    return pose_from_numbers(content, str(path), frame)


def pose_from_numbers(content: Any, name: str, frame: int = 0) -> BodyPose:
    """Parse a list, or a mapping with "pose" and "translation"; errors call it `name`. Raises ValueError."""
    pose, translation = content, [0.0, 0.0, 0.0]
    if isinstance(content, dict):
        pose = _first(content, POSE_KEYS, None)
        translation = _first(content, TRANSLATION_KEYS, translation)
    try:
        with np.errstate(over="ignore"):  # infinite numbers are rejected below
            theta = np.asarray(pose)
            reject_matrices(theta)
            theta = body_theta(_numbers(_frame(_a_row_a_pose(theta), frame)))
            move = _numbers(_frame(np.asarray(translation), frame)[:3])
        if len(move) < 3:
            raise ValueError(f"{len(move)} numbers instead of 3")
    except (TypeError, ValueError, IndexError, OverflowError) as e:
        raise ValueError(f"{name} holds no pose: it needs {3 * J} axis-angle numbers ({J} joints x 3, radians)") from e
    if not (np.isfinite(theta).all() and np.isfinite(move).all()):
        raise ValueError(f"{name} holds NaN or infinite numbers: export the pose again")
    if max(np.abs(theta).max(initial=0), np.abs(move).max(initial=0)) > LARGEST_NUMBER:
        raise ValueError(f"{name} holds numbers above {LARGEST_NUMBER:g}, which are no angles or metres")
    return BodyPose.from_axis_angle(torch.from_numpy(theta), torch.from_numpy(move))


def _numbers(values: Any) -> NDArray[np.float32]:
    given = np.asarray(values)
    if given.dtype.kind not in "iuf":
        raise TypeError(f"{given.dtype} instead of numbers")
    return given.astype(np.float32)


def _first(content: dict[str, Any], keys: tuple[str, ...], default: Any) -> Any:
    return next((content[key] for key in keys if key in content), default)


def reject_matrices(values: NDArray) -> None:
    """Raise ValueError for rotation matrices [F, n, 3, 3], whose numbers would be taken for those of axis-angle."""
    if values.ndim == 4:
        raise ValueError("rotation matrices instead of axis-angle numbers")


def body_theta(values: NDArray) -> NDArray:
    """Convert poses [..., n] of SMPL, of 22 joints without hands, of SMPL-H or SMPL-X to SMPL's [..., 72].

    SMPL-H and SMPL-X have jaw, eyes or fingers in place of SMPL's two hand joints, which therefore stay at rest.
    Raises ValueError for another n.
    """
    count = values.shape[-1]
    if count == 3 * J:
        return values.copy()
    if count != BODY_NUMBERS and (count < 3 * J or count % 3):
        raise ValueError(f"{count} numbers instead of {3 * J}")
    hands = np.zeros((*values.shape[:-1], 3 * J - BODY_NUMBERS), values.dtype)
    return np.concatenate([values[..., :BODY_NUMBERS], hands], axis=-1)


def _a_row_a_pose(values: NDArray) -> NDArray:
    """Flatten a pose given as rows of joints."""
    return values.reshape(-1) if values.ndim == 2 and values.shape[1] == 3 else values


def _frame(values: NDArray, frame: int) -> NDArray:
    """Select a frame, or return the only one."""
    return values[frame].reshape(-1) if values.ndim >= 2 else values
