"""Poses of files and messages, as the body model takes them; `formats.poses` reads them for both programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from primdiffusion.body.model import BodyPose
from primdiffusion.formats.poses import files
from primdiffusion.formats.poses.motion import Motion


def read_motion(path: str | Path, person: str = "") -> BodyPose:
    """Read all frames of a file (`formats.poses.files`): rotations [F, 24, 3, 3], translations [F, 3] in metres, y up.

    `person` is one of several people in it; by default who is in the most frames.
    Raises FileNotFoundError or FileError.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"the pose file {path} does not exist: check the path")
    return _as_pose(files.read_motion(path, person=person))


def read_pose(path: str | Path, frame: int = 0, person: str = "") -> BodyPose:
    """Read a `frame` of a file as `read_motion`, or its only pose.

        >>> pose = pd.read_pose("walk.npz", frame=5)
        >>> pose.joint_rotation.shape
        torch.Size([24, 3, 3])

    Raises FileNotFoundError and ValueError.
    """
    return _frame(read_motion(path, person), str(path), frame)


def pose_from_numbers(content: Any, name: str) -> BodyPose:
    """Parse a list, or a mapping with "pose" and "translation"; errors call it `name`. Raises ValueError."""
    return _frame(_as_pose(files.motion_from_numbers(content, name)), name, 0)


def _as_pose(motion: Motion) -> BodyPose:
    return BodyPose(*(torch.from_numpy(a.astype(np.float32)) for a in (motion.rotations, motion.translations)))


def _frame(poses: BodyPose, name: str, frame: int) -> BodyPose:
    frames = len(poses.translation)
    if frames > 1 and not 0 <= frame < frames:
        raise ValueError(f"{name} has {frames} frames, counted from 0: there is no frame {frame}, choose another")
    return poses.map(lambda values: values[frame if frames > 1 else 0])
