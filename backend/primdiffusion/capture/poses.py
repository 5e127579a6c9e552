"""Poses of captures: built-in ones, frames of motion files, and a selection of poses that differ most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from primdiffusion.body.model import BodyPose, J, default_body
from primdiffusion.body.smpl_pickle import as_array, load_restricted
from primdiffusion.formats.arrays import ArrayFileError, all_finite, read_npy, read_numbers
from primdiffusion.formats.json_files import read_json
from primdiffusion.formats.motion_size import MotionTooLongError, check_motion_size
from primdiffusion.formats.regular_files import read_regular
from primdiffusion.formats.rotations import first_improper, improper_text
from primdiffusion.geometry.rotation import axis_angle_to_matrix, matrix_to_axis_angle
from primdiffusion.pose_file import body_theta, reject_matrices

POSES, ROOT, REST = ("poses", "pose", "theta", "fullpose"), ("global_orient", "root_orient"), ("body_pose", "pose_body")
TRANSLATIONS = ("trans", "transl", "translation")
KEYS = (*POSES, *ROOT, *REST, *TRANSLATIONS)
CLEARLY_UP = 0.6
"""Smallest mean cosine between the pelvis' up and an axis for which that axis is up."""
MOST_CANDIDATES = 2000
"""Frames to choose from; longer motions are subsampled evenly."""
FRAMES_AT_ONCE = 4096
"""Frames whose rotations are made at once: in float64 that takes several times their memory."""
LARGEST_PICKLE = 64 * 2**20
"""Bytes of a .pkl."""
BUILT_IN = Path(__file__).parent / "data" / "poses.json"
"""The extension's poses, 72 axis-angle values by name; made by scripts/bake_poses."""


class MotionFileError(ValueError):
    """An unreadable pose file; the message names it."""


def built_in_poses() -> BodyPose:
    """All built-in poses, the near-T pose first: rotations [20, 24, 3, 3]."""
    turns = np.array(list(read_json(BUILT_IN).values()))
    return _as_pose(turns, np.zeros((len(turns), 3)))


def read_motion(path: str | Path) -> BodyPose:
    """Read all frames of a file: rotations [F, 24, 3, 3], translations [F, 3] in metres, y up.

    .npz of AMASS, of "poses" or "pose" [F, 72 or more], or of "global_orient" and "body_pose"; .npy or .json of the
    same; .pkl, a dictionary of such arrays as estimators of SMPL write it. Numbers of axis-angle, or matrices. Hands of
    SMPL-H and SMPL-X are dropped (`pose_file.body_theta`). AMASS files ("trans" with "poses" or
    "pose_body") are rotated so that y is up. The extension, which cannot import the backend, has its own reader; a test
    compares both. Raises FileNotFoundError, ArrayFileError or MotionFileError.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"the pose file {path} does not exist: check the path")
    if path.suffix == ".pkl":
        content = _read_pickle(path)
    else:
        content = read_numbers(path, (), KEYS) if path.suffix == ".npz" else _read_plain(path)
    try:
        check_motion_size(path, max((values.size for values in content.values()), default=0))
    except MotionTooLongError as e:
        raise MotionFileError(str(e)) from e
    turns = _turns(path, content)
    move = np.asarray(_first(content, TRANSLATIONS, np.zeros(3)), np.float64)
    if move.size not in (3, 3 * len(turns)) or not all_finite(move):
        raise MotionFileError(
            f"{path} has {len(turns)} frames, but its translations have shape {move.shape} or are not finite: "
            "export it again"
        )
    pose = _as_pose(turns, np.broadcast_to(move.reshape(-1, 3), (len(turns), 3)))
    is_amass = path.suffix == ".npz" and "trans" in content and ("poses" in content or "pose_body" in content)
    return _upright(pose) if is_amass else pose


def read_motions(paths: Sequence[Path]) -> tuple[list[BodyPose], list[str]]:
    """Read motion files; return the motions, and an error message for each unreadable file."""
    motions, failures = [], []
    for path in paths:
        try:
            motions.append(read_motion(path))
        except (FileNotFoundError, ArrayFileError, MotionFileError) as e:
            failures.append(str(e))
    return motions, failures


def choose_poses(motions: Sequence[BodyPose], count: int, seed: int) -> BodyPose:
    """Choose `count` poses: near T first, then those of `motions` (or the built-in ones) farthest from all before.

    The distance of poses is that of the joints relative to the pelvis of an average body. Translations are dropped.

    Raises:
        ValueError: `count` is not positive or exceeds the number of poses.
    """
    near_t = built_in_poses().map(lambda t: t[:1])
    rest = list(motions) or [built_in_poses().map(lambda t: t[1:])]
    rotation = torch.cat([near_t.joint_rotation, *(pose.joint_rotation for pose in rest)])
    if not 1 <= count <= len(rotation):
        raise ValueError(f"{count} poses were requested: there are {len(rotation)}, including the near-T pose")
    chosen = rotation
    if motions:
        candidates = np.unique(np.linspace(1, len(rotation) - 1, min(MOST_CANDIDATES, len(rotation) - 1)).astype(int))
        if len(candidates) < count - 1:
            candidates = np.arange(1, len(rotation))
        considered = np.concatenate([[0], candidates])
        chosen = rotation[considered][_spread(rotation[considered], count, seed)]
    return BodyPose(chosen[:count], torch.zeros(count, 3))


def _spread(rotation: Float[torch.Tensor, "F J 3 3"], count: int, seed: int) -> list[int]:
    """Farthest-point sampling from frame 0; the seed breaks ties and near ties."""
    joints = default_body().shape(torch.zeros(1)).pose(BodyPose(rotation, torch.zeros(len(rotation), 3))).joints
    places = joints[..., :3, 3] - joints[..., :1, :3, 3]
    preference = 1 + 0.1 * torch.from_numpy(np.random.default_rng(seed).random(len(rotation))).float()
    taken = [0]
    distance = torch.full((len(rotation),), torch.inf)
    while len(taken) < count:
        distance = torch.minimum(distance, (places - places[taken[-1]]).norm(dim=-1).mean(-1))
        score = distance * preference
        score[taken] = -1
        taken.append(int(score.argmax()))
    return taken


def _as_pose(turns: NDArray, translation: NDArray) -> BodyPose:
    blocks = torch.from_numpy(turns.reshape(-1, J, 3)).split(FRAMES_AT_ONCE)
    rotation = torch.cat([axis_angle_to_matrix(block).float() for block in blocks])
    return BodyPose(rotation, torch.from_numpy(np.array(translation, np.float32)))


def _read_pickle(path: Path) -> dict[str, NDArray]:
    """The arrays of a pickled dictionary, read without executing code from it."""
    try:
        content = load_restricted(read_regular(path, LARGEST_PICKLE), str(path))
        if not isinstance(content, dict):
            raise ValueError(f"it contains a {type(content).__name__}")
        return {key: np.asarray(as_array(content[key]), np.float64) for key in KEYS if key in content}
    except (ValueError, TypeError, OSError) as e:
        raise MotionFileError(f"{path} is not a pickled dictionary of poses ({e!s:.160}): save it as .npz") from e


def _read_plain(path: Path) -> dict[str, NDArray]:
    try:
        if path.suffix == ".npy":
            return {"poses": read_npy(path)}
        content = read_json(path)
        if not isinstance(content, dict):
            content = {"poses": content}
        return {key: np.asarray(content[key], np.float64) for key in KEYS if key in content}
    except (ValueError, TypeError, OSError, EOFError) as e:
        raise MotionFileError(
            f"{path} is not a pose file ({e!s:.160}): give axis-angle values as .npz, .npy or .json"
        ) from e


def _turns(path: Path, content: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Axis-angle vectors [F, 24, 3]."""
    try:
        values = _rows(_first(content, REST, None), _first(content, ROOT, None), _first(content, POSES, None))
        turns = body_theta(values).reshape(-1, J, 3)
    except (ValueError, TypeError) as e:
        raise MotionFileError(
            f"{path} contains no poses ({e!s:.99}): it needs {3 * J} axis-angle values per frame ({J} x 3, radians)"
        ) from e
    if not len(turns) or not all_finite(turns):
        raise MotionFileError(f"{path} has no frames, or NaN or infinite values: export it again")
    return turns


def _rows(rest: NDArray | None, root: NDArray | None, poses: NDArray | None) -> NDArray[np.float64]:
    """Join the parts of a pose to one row per frame [F, n], pelvis first."""
    if rest is None:
        if poses is None:
            raise ValueError("it has no array with a known name")
        return _frames(poses)
    body = _frames(rest, joints_before=1)
    turn = np.zeros(3) if root is None else np.asarray(root, np.float64)
    if turn.ndim > 2 and turn.shape[-2:] == (3, 3):
        turn = _frames(turn.reshape(-1, 1, 3, 3))
    if turn.size not in (3, 3 * len(body)):
        raise ValueError(f"global_orient of shape {turn.shape} for {len(body)} frames")
    return np.concatenate([np.broadcast_to(turn.reshape(-1, 3), (len(body), 3)), body], axis=1)


def _frames(values: NDArray, joints_before: int = 0) -> NDArray[np.float64]:
    """Axis-angle numbers [F, n] of those, or of matrices. Raises ValueError for matrices that are no rotations."""
    values = np.asarray(values, np.float64)
    if values.ndim == 4 and values.shape[-2:] == (3, 3):
        if improper := first_improper(values):
            raise ValueError(improper_text(improper[0], improper[1] + joints_before))
        return matrix_to_axis_angle(torch.from_numpy(values)).flatten(1).numpy()
    reject_matrices(values)
    values = values[None] if values.ndim == 1 or (values.ndim == 2 and values.shape[1] == 3) else values
    return values.reshape(len(values), -1)


def _first(content: Mapping[str, NDArray], keys: Sequence[str], default: NDArray | None) -> NDArray | None:
    return next((content[key] for key in keys if key in content), default)


def _upright(pose: BodyPose) -> BodyPose:
    """Rotate a motion so that y is up, assuming that the mean up direction of the pelvis is the world's."""
    mean = pose.joint_rotation[:, 0, :, 1].mean(0)
    axis = int(mean.abs().argmax())
    if (axis == 1 and mean[1] > 0) or mean[axis].abs() < CLEARLY_UP:
        return pose
    turn = _shortest_turn_to_y(axis, float(mean[axis].sign())).to(pose.joint_rotation)
    rotation = pose.joint_rotation.clone()
    rotation[:, 0] = turn @ rotation[:, 0]
    pelvis = default_body().shape(torch.zeros(1)).joints[0]  # translations are relative to the pelvis of the rest pose
    return BodyPose(rotation, (pose.translation + pelvis) @ turn.T - pelvis)


def _shortest_turn_to_y(axis: int, sign: float) -> Float[torch.Tensor, "3 3"]:
    """Rotation from a world axis to y; from -y, half a turn about z."""
    if axis == 1:
        return torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    turn = torch.zeros(3, 3)
    other = 2 - axis
    turn[1, axis], turn[axis, 1], turn[other, other] = sign, -sign, 1.0
    return turn
