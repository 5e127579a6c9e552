"""Poses as people keep them: 72 axis-angle numbers (24 joints x 3, radians, SMPL's order, the pelvis first)."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from primdiffusion.body.model import BodyPose, J

POSE_KEYS = ("pose", "poses", "theta")
TRANSLATION_KEYS = ("translation", "trans", "transl")


class PoseFileError(ValueError):
    """A pose that cannot be understood."""


def read_pose(path: str | Path, frame: int = 0) -> BodyPose:
    """The pose in a .json or .npz file, from one `frame` where it holds several (AMASS: `poses` [F, 156], `trans`).

    JSON: a list of 72 numbers or 24 rows of 3, or an object with one under "pose" and, if wanted, "translation" in
    metres. Joints beyond the 24th (hands of SMPL-H and SMPL-X) are left out. Raises FileNotFoundError or PoseFileError.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no pose file {path}: check the path")
    try:
        content: Any = json.loads(path.read_text("utf-8")) if path.suffix == ".json" else _arrays(path)
    except (ValueError, OSError, zipfile.BadZipFile) as e:
        raise PoseFileError(
            f"{path} is neither JSON nor an npz of plain arrays ({e}): convert it to one of these"
        ) from e
    return pose_from_numbers(content, str(path), frame)


def pose_from_numbers(content: Any, name: str, frame: int = 0) -> BodyPose:
    """The pose in a list, or in a mapping with "pose" and "translation"; `name` is what an error calls it."""
    pose, translation = content, [0.0, 0.0, 0.0]
    if isinstance(content, dict):
        pose = _first(content, POSE_KEYS, None)
        translation = _first(content, TRANSLATION_KEYS, translation)
    try:
        theta = _frame(np.asarray(pose, dtype=np.float32), 3 * J, frame)
        move = _frame(np.asarray(translation, dtype=np.float32), 3, frame)
    except (TypeError, ValueError, IndexError) as e:
        raise PoseFileError(
            f"{name} holds no pose: it needs {3 * J} axis-angle numbers ({J} joints x 3, radians)"
        ) from e
    if not (np.isfinite(theta).all() and np.isfinite(move).all()):
        raise PoseFileError(f"{name} holds NaN or infinite numbers: export the pose again")
    return BodyPose.from_axis_angle(torch.from_numpy(theta), torch.from_numpy(move))


def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in (*POSE_KEYS, *TRANSLATION_KEYS) if name in stored}


def _first(content: dict[str, Any], keys: tuple[str, ...], default: Any) -> Any:
    return next((content[key] for key in keys if key in content), default)


def _frame(values: np.ndarray, wanted: int, frame: int) -> np.ndarray:
    """One row of `wanted` values: `values` itself, its rows of joints, or one frame of several."""
    if values.ndim == 2 and values.shape[1] == 3 and wanted > 3:
        values = values.reshape(-1)
    if values.ndim >= 2:
        values = values[frame].reshape(-1)
    if len(values) < wanted:
        raise ValueError(f"{len(values)} numbers instead of {wanted}")
    return values[:wanted].copy()
