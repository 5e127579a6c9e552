"""Files of postures: what a fit found, to start from again or to keep; and pose files of others to start from.

posture.json: {"format": "primdiffusion-posture", "pose": [v][72], "translation": [v][3], "betas": [10],
"cameras": {"camera0000": {"K": 3x3, "R": 3x3, "T": [3]}, ...}}: axis-angle numbers in radians, metres, y up; betas of
the default body; cameras of the whole upright pictures, OpenCV.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyPose
from primdiffusion.body.pose_file import read_motion
from primdiffusion.capture.reader import views_in
from primdiffusion.files.json_files import read_json
from primdiffusion.files.regular_files import FileError, as_file_error
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.formats.camera_rig import View
from primdiffusion.geometry.rotation import matrix_to_axis_angle

FORMAT = "primdiffusion-posture"
BETAS = 10
LARGEST_BETA = 5.0


@dataclasses.dataclass(frozen=True, eq=False)
class PostureFile:
    """What a pose file says; only our own say more than poses."""

    pose: BodyPose
    """[n]."""
    betas: Float[Tensor, "10"] | None = None
    views: list[View] | None = None
    """Cameras of the whole pictures."""


def read_posture(path: Path, sizes: Sequence[tuple[int, int]]) -> PostureFile:
    """Read a pose file (`primdiffusion.body.pose_file`) or a posture of pictures of `sizes` (width, height).

    Raises FileNotFoundError, and ValueError for what is no pose or of another rig; the message names the file.
    """
    pose = read_motion(path)
    content = read_json(path) if path.suffix.lower() == ".json" else None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        return PostureFile(pose)
    with as_file_error(path, "has no betas", "fit the pose again"):
        betas = torch.from_numpy(np.asarray(content["betas"], np.float32))
    if betas.shape != (BETAS,) or not (betas.abs() <= LARGEST_BETA).all():
        raise FileError(path, f"has other betas than {BETAS} up to {LARGEST_BETA:g}", "fit the pose again")
    return PostureFile(pose, betas, _views(content.get("cameras"), path, sizes))


def read_cameras(path: Path, sizes: Sequence[tuple[int, int]]) -> list[View]:
    """Read a cameras.json, or the cameras of a posture, one for each picture of `sizes`.

    Raises FileNotFoundError and FileError.
    """
    try:
        content = read_json(path)
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no file of cameras {path}: check the path") from None
    except (OSError, ValueError) as e:
        raise FileError(path, f"cannot be read ({e!s:.120})", "give a cameras.json") from e
    return _views(content.get("cameras", content) if isinstance(content, dict) else content, path, sizes)


def write_posture(path: Path, pose: BodyPose, betas: Float[Tensor, "10"], views: Sequence[View]) -> None:
    """Write a posture, whole or not at all. Raises OSError."""
    theta = matrix_to_axis_angle(pose.joint_rotation).flatten(1)
    content = {
        "format": FORMAT,
        "pose": _rounded(theta),
        "translation": _rounded(pose.translation),
        "betas": _rounded(betas),
        "cameras": {
            f"camera{number:04d}": {
                "K": view.intrinsics.tolist(),
                "R": view.rotation.tolist(),
                "T": view.translation.tolist(),
            }
            for number, view in enumerate(views)
        },
    }
    write_atomically(path, json.dumps(content))


def _rounded(values: Tensor) -> Any:
    return values.double().numpy().round(6).tolist()


def _views(named: Any, path: Path, sizes: Sequence[tuple[int, int]]) -> list[View]:
    size: Callable[[int], tuple[int, int]] = sizes.__getitem__
    if not isinstance(named, dict) or len(named) != len(sizes):
        count = len(named) if isinstance(named, dict) else "no"
        raise FileError(path, f"has {count} cameras for {len(sizes)} pictures", "give one for each")
    views = views_in(named, path, size)
    for number, view in enumerate(views):
        if min(view.intrinsics[0, 0], view.intrinsics[1, 1]) < 1:
            raise FileError(path, f"has no camera in camera{number:04d}", "K has focal lengths in pixels")
    return views
