"""Poses to capture people in: built-in ones, frames of motion files, and a choice of few that differ much."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from primdiffusion.body.model import BodyPose, J, default_body
from primdiffusion.capture.plain_npz import read_npz
from primdiffusion.geometry.rotation import axis_angle_to_matrix

MOTION_KEYS = ("poses", "pose", "theta", "global_orient", "body_pose")
TRANSLATION_KEYS = ("trans", "transl", "translation")
AMASS_KEYS = ("mocap_framerate", "mocap_frame_rate")
"""Their presence tells a file of AMASS, whose z is up."""
MOST_CANDIDATES = 2000
"""Frames among which few are chosen; of more, these many evenly spaced."""
BUILT_IN = Path(__file__).parent / "data" / "poses.json"
"""Made by scripts/bake_poses: the poses that the extension has, 72 axis-angle numbers by name."""


class MotionFileError(ValueError):
    """A file of poses that cannot be understood; one sentence that names it."""


def built_in_poses() -> BodyPose:
    """All built-in poses, the near-T pose first: rotations [20, 24, 3, 3]."""
    turns = np.array(list(json.loads(BUILT_IN.read_text(encoding="utf-8")).values()))
    return _as_pose(turns, np.zeros((len(turns), 3)))


def read_motion(path: str | Path) -> BodyPose:
    """Every frame of a file: rotations [F, 24, 3, 3], translations [F, 3] in metres, y up.

    .npz of AMASS (its z becomes y; hands are left out), of "poses" or "pose" [F, >= 72], or of "global_orient" and
    "body_pose"; .npy or .json of 72 numbers a frame. Raises FileNotFoundError, NpzError or MotionFileError.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no pose file {path}: check the path")
    if path.suffix == ".npz":
        content = read_npz(path, (), (*MOTION_KEYS, *TRANSLATION_KEYS, *AMASS_KEYS))
    else:
        content = _read_plain(path)
    turns = _turns(path, content)
    move = next((content[key] for key in TRANSLATION_KEYS if key in content), np.zeros((len(turns), 3)))
    move = np.broadcast_to(np.asarray(move, np.float64).reshape(-1, 3), (len(turns), 3))
    pose = _as_pose(turns, move)
    return _upright(pose) if any(key in content for key in AMASS_KEYS) else pose


def choose_poses(files: Sequence[Path], count: int, seed: int) -> BodyPose:
    """`count` poses: near T first, then those of `files` (none: built in) that lie farthest from the ones before.

    Distance is that of the joints about the pelvis of an average body. Poses are taken in place, without translation.

    Raises:
        ValueError: count is not positive, or there are fewer poses.
        FileNotFoundError, NpzError, MotionFileError: a file cannot be read.
    """
    near_t = built_in_poses().map(lambda t: t[:1])
    rest = [read_motion(file) for file in files] or [built_in_poses().map(lambda t: t[1:])]
    rotation = torch.cat([near_t.joint_rotation, *(pose.joint_rotation for pose in rest)])
    if not 1 <= count <= len(rotation):
        raise ValueError(f"{count} poses were asked for: there are {len(rotation)}, the near-T pose included")
    chosen = rotation
    if files:
        candidates = np.unique(np.linspace(1, len(rotation) - 1, min(MOST_CANDIDATES, len(rotation) - 1)).astype(int))
        if len(candidates) < count - 1:
            candidates = np.arange(1, len(rotation))
        kept = np.concatenate([[0], candidates])
        chosen = rotation[kept][_spread(rotation[kept], count, seed)]
    return BodyPose(chosen[:count], torch.zeros(count, 3))


def _spread(rotation: Float[torch.Tensor, "F J 3 3"], count: int, seed: int) -> list[int]:
    """Farthest-point choice from frame 0; ties and near ties are broken by the seed."""
    joints = default_body().shape(torch.zeros(1)).pose(BodyPose(rotation, torch.zeros(len(rotation), 3))).joints
    places = joints[..., :3, 3] - joints[..., :1, :3, 3]
    liking = 1 + 0.1 * torch.from_numpy(np.random.default_rng(seed).random(len(rotation))).float()
    taken = [0]
    distance = torch.full((len(rotation),), torch.inf)
    while len(taken) < count:
        distance = torch.minimum(distance, (places - places[taken[-1]]).norm(dim=-1).mean(-1))
        score = distance * liking
        score[taken] = -1
        taken.append(int(score.argmax()))
    return taken


def _as_pose(turns: NDArray, translation: NDArray) -> BodyPose:
    rotation = axis_angle_to_matrix(torch.from_numpy(turns.reshape(-1, J, 3)))
    return BodyPose(rotation.float(), torch.from_numpy(np.array(translation, np.float32)))


def _read_plain(path: Path) -> dict[str, NDArray]:
    try:
        if path.suffix == ".npy":
            return {"poses": np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)}
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            content = {"poses": content}
        keys = (*MOTION_KEYS, *TRANSLATION_KEYS)
        return {key: np.asarray(content[key], np.float64) for key in keys if key in content}
    except (ValueError, TypeError, OSError, EOFError, RecursionError) as e:
        raise MotionFileError(f"{path} is no pose file ({e}): give .npz, .npy or .json of axis-angle numbers") from e


def _turns(path: Path, content: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Axis-angle vectors [F, 24, 3]."""
    wanted = f"{3 * J} axis-angle numbers a frame ({J} joints x 3, radians)"
    try:
        if "body_pose" in content:
            body = np.asarray(content["body_pose"], np.float64)
            body = body.reshape(-1, 3 * (J - 1)) if body.size % (3 * (J - 1)) == 0 else body.reshape(-1, 63)
            body = np.pad(body, ((0, 0), (0, 3 * (J - 1) - body.shape[1])))
            root = np.asarray(content.get("global_orient", np.zeros((len(body), 3))), np.float64).reshape(-1, 3)
            values = np.concatenate([root, body], axis=1)
        else:
            values = np.asarray(next(content[key] for key in MOTION_KEYS if key in content), np.float64)
            values = values[None] if values.ndim == 1 or values.shape == (J, 3) else values
            values = values.reshape(len(values), -1)
            if values.shape[1] < 3 * J:
                raise ValueError(f"{values.shape[1]} numbers")
        turns = values[:, : 3 * J].reshape(-1, J, 3)
    except (StopIteration, ValueError, TypeError) as e:
        raise MotionFileError(f"{path} holds no poses ({e or 'none of the usual keys'}): it needs {wanted}") from e
    if not len(turns) or not np.isfinite(turns).all():
        raise MotionFileError(f"{path} holds no frame, or NaN or infinite numbers: export it again")
    return turns


def _upright(pose: BodyPose) -> BodyPose:
    """From z up to y up: a quarter turn about x."""
    turn = pose.joint_rotation.new_tensor([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    rotation = pose.joint_rotation.clone()
    rotation[:, 0] = turn @ rotation[:, 0]
    return BodyPose(rotation, pose.translation @ turn.T)
