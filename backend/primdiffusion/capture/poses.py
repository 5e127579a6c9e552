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
from primdiffusion.formats.arrays import ArrayFileError, read_numbers
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.pose_file import body_theta

POSES, ROOT, REST = ("poses", "pose", "theta", "fullpose"), ("global_orient", "root_orient"), ("body_pose", "pose_body")
TRANSLATIONS = ("trans", "transl", "translation")
KEYS = (*POSES, *ROOT, *REST, *TRANSLATIONS)
CLEARLY_UP = 0.6
"""Mean cosine between the pelvis' own up and an axis from which on that axis counts as up."""
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

    .npz of AMASS, of "poses" or "pose" [F, 72 or more], or of "global_orient" and "body_pose"; .npy or .json of the
    same. Hands of SMPL-H and SMPL-X are left out (`pose_file.body_theta`). AMASS (its names are "trans" with "poses"
    or "pose_body") is turned so that y is up. The extension has a reader of its own, for it imports nothing of the
    backend; a test holds both to the same poses. Raises FileNotFoundError, ArrayFileError or MotionFileError.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no pose file {path}: check the path")
    content = read_numbers(path, (), KEYS) if path.suffix == ".npz" else _read_plain(path)
    turns = _turns(path, content)
    move = np.asarray(_first(content, TRANSLATIONS, np.zeros(3)), np.float64)
    if move.size not in (3, 3 * len(turns)) or not np.isfinite(move).all():
        raise MotionFileError(
            f"{path} has {len(turns)} frames of poses but translations of shape {move.shape}, or not finite: export it "
            "again"
        )
    pose = _as_pose(turns, np.broadcast_to(move.reshape(-1, 3), (len(turns), 3)))
    is_amass = path.suffix == ".npz" and "trans" in content and ("poses" in content or "pose_body" in content)
    return _upright(pose) if is_amass else pose


def read_motions(paths: Sequence[Path]) -> tuple[list[BodyPose], list[str]]:
    """The motions of the files that can be read, and a sentence for each that cannot."""
    motions, failures = [], []
    for path in paths:
        try:
            motions.append(read_motion(path))
        except (FileNotFoundError, ArrayFileError, MotionFileError) as e:
            failures.append(str(e))
    return motions, failures


def choose_poses(motions: Sequence[BodyPose], count: int, seed: int) -> BodyPose:
    """`count` poses: near T first, then those of `motions` (none: built in) that lie farthest from the ones before.

    Distance is that of the joints about the pelvis of an average body. Poses are taken in place, without translation.

    Raises:
        ValueError: count is not positive, or there are fewer poses.
    """
    near_t = built_in_poses().map(lambda t: t[:1])
    rest = list(motions) or [built_in_poses().map(lambda t: t[1:])]
    rotation = torch.cat([near_t.joint_rotation, *(pose.joint_rotation for pose in rest)])
    if not 1 <= count <= len(rotation):
        raise ValueError(f"{count} poses were asked for: there are {len(rotation)}, the near-T pose included")
    chosen = rotation
    if motions:
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
        return {key: np.asarray(content[key], np.float64) for key in KEYS if key in content}
    except (ValueError, TypeError, OSError, EOFError, RecursionError) as e:
        raise MotionFileError(f"{path} is no pose file ({e}): give .npz, .npy or .json of axis-angle numbers") from e


def _turns(path: Path, content: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Axis-angle vectors [F, 24, 3]."""
    try:
        values = _rows(_first(content, REST, None), _first(content, ROOT, None), _first(content, POSES, None))
        turns = body_theta(values).reshape(-1, J, 3)
    except (ValueError, TypeError) as e:
        raise MotionFileError(
            f"{path} holds no poses ({e}): it needs {3 * J} axis-angle numbers a frame ({J} joints x 3, radians)"
        ) from e
    if not len(turns) or not np.isfinite(turns).all():
        raise MotionFileError(f"{path} holds no frame, or NaN or infinite numbers: export it again")
    return turns


def _rows(rest: NDArray | None, root: NDArray | None, poses: NDArray | None) -> NDArray[np.float64]:
    """A row a frame [F, n], the pelvis first, of poses in two parts or whole."""
    if rest is None:
        if poses is None:
            raise ValueError("none of the usual names")
        return _frames(poses)
    body = _frames(rest)
    turn = np.zeros(3) if root is None else np.asarray(root, np.float64)
    if turn.size not in (3, 3 * len(body)):
        raise ValueError(f"global_orient of shape {turn.shape} for {len(body)} frames")
    return np.concatenate([np.broadcast_to(turn.reshape(-1, 3), (len(body), 3)), body], axis=1)


def _frames(values: NDArray) -> NDArray[np.float64]:
    values = np.asarray(values, np.float64)
    values = values[None] if values.ndim == 1 or (values.ndim == 2 and values.shape[1] == 3) else values
    return values.reshape(len(values), -1)


def _first(content: Mapping[str, NDArray], keys: Sequence[str], default: NDArray | None) -> NDArray | None:
    return next((content[key] for key in keys if key in content), default)


def _upright(pose: BodyPose) -> BodyPose:
    """With y up: people stand, sit and walk more than they lie, so the mean of the pelvis' up is the world's."""
    mean = pose.joint_rotation[:, 0, :, 1].mean(0)
    axis = int(mean.abs().argmax())
    if (axis == 1 and mean[1] > 0) or mean[axis].abs() < CLEARLY_UP:
        return pose
    turn = _shortest_turn_to_y(axis, float(mean[axis].sign())).to(pose.joint_rotation)
    rotation = pose.joint_rotation.clone()
    rotation[:, 0] = turn @ rotation[:, 0]
    pelvis = default_body().shape(torch.zeros(1)).joints[0]  # a translation moves a body whose pelvis rests there
    return BodyPose(rotation, (pose.translation + pelvis) @ turn.T - pelvis)


def _shortest_turn_to_y(axis: int, sign: float) -> Float[torch.Tensor, "3 3"]:
    """The rotation that takes a world axis to y; half a turn, from -y, is about z."""
    if axis == 1:
        return torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    turn = torch.zeros(3, 3)
    other = 2 - axis
    turn[1, axis], turn[axis, 1], turn[other, other] = sign, -sign, 1.0
    return turn
