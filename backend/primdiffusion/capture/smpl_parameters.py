"""SMPL parameters of a subject: our plain file, or the released code's pickle through the restricted reader."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from primdiffusion.body.model import BodyPose, J
from primdiffusion.files.arrays import all_finite, read_numbers, read_pickled_bytes
from primdiffusion.files.regular_files import FileError, as_file_error
from primdiffusion.files.smpl_pickle import array_of_objects, as_array, load_restricted
from primdiffusion.formats.capture_layout import SMPL_FILE, SMPL_FOLDER, SMPL_PLAIN_FILE
from primdiffusion.formats.poses.motion import check_motion_size

KEYS = ("global_orient", "body_pose", "betas", "transl")


@dataclasses.dataclass(frozen=True, eq=False)
class SmplParameters:
    """Shape and poses of a subject."""

    theta: Float32[np.ndarray, "F n"]
    """72 axis-angle values per frame, pelvis first."""
    translation: Float32[np.ndarray, "F 3"]
    """Metres."""
    betas: Float32[np.ndarray, "B"]

    def pose(self, frame: int) -> BodyPose:
        """The pose in a frame."""
        return BodyPose.from_axis_angle(torch.from_numpy(self.theta[frame]), torch.from_numpy(self.translation[frame]))


def read_smpl(subject: Path) -> SmplParameters:
    """Read the parameters in a subject's folder.

    Raises:
        FileNotFoundError: neither file exists.
        FileError: the file is damaged or has other contents, or its pickle contains more than arrays.
    """
    plain, pickled = subject / SMPL_FOLDER / SMPL_PLAIN_FILE, subject / SMPL_FOLDER / SMPL_FILE
    if plain.is_file():
        return _checked(plain, read_numbers(plain, KEYS))
    if pickled.is_file():
        return _checked(pickled, _read_pickled(pickled))
    raise FileNotFoundError(f"{plain.parent} has neither {plain.name} nor {pickled.name}: render the subject again")


def _read_pickled(path: Path) -> dict[str, np.ndarray]:
    """Read the dictionary from a 0-d object array, without executing code from it."""
    pickled = read_pickled_bytes(path, "smpl")
    with as_file_error(path, "contains no dictionary of SMPL parameters", "download it again"):
        (content,) = array_of_objects(load_restricted(pickled, path))
        if not isinstance(content, dict):
            raise ValueError(f"it contains a {type(content).__name__}")
        if missing := [key for key in KEYS if key not in content]:
            raise FileError(path, f"lacks {missing[0]!r}", "render the subject again, or download the file again")
        return {key: as_array(content[key]) for key in KEYS}


def _checked(path: Path, arrays: dict[str, np.ndarray]) -> SmplParameters:
    check_motion_size(path, max(values.size for values in arrays.values()))
    frames = next(iter(arrays["global_orient"].shape), 0)
    shapes = {"global_orient": (frames, 3), "body_pose": (frames, 3 * (J - 1)), "transl": (frames, 3)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise FileError(path, f"has {name} of shape {arrays[name].shape}, not {shape}", "render the subject again")
    betas = arrays["betas"].reshape(-1)
    if not all(map(all_finite, arrays.values())) or not frames or arrays["betas"].ndim > 2:
        raise FileError(path, "has no frames, or NaN or infinite values", "render the subject again")
    return SmplParameters(
        theta=np.concatenate([arrays["global_orient"], arrays["body_pose"]], axis=1).astype(np.float32),
        translation=arrays["transl"].astype(np.float32),
        betas=betas.astype(np.float32),
    )
