"""Poses of captures: built-in ones, frames of motion files, and a selection of poses that differ most."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.formats.poses.motion import built_in_vectors
from primdiffusion.geometry.rotation import axis_angle_to_matrix

MOST_CANDIDATES = 2000
"""Frames to choose from; longer motions are subsampled evenly."""


def built_in_poses() -> BodyPose:
    """All built-in poses, the near-T pose first: rotations [20, 24, 3, 3]."""
    turns = torch.from_numpy(np.array(list(built_in_vectors().values())))
    return BodyPose(axis_angle_to_matrix(turns).float(), torch.zeros(len(turns), 3))


def turned(poses: BodyPose, yaw: Float[np.ndarray, "F"]) -> BodyPose:
    """Turn the poses [F] about the vertical through the pelvis, radians."""
    axis = torch.from_numpy(np.stack([0 * yaw, yaw, 0 * yaw], axis=-1)).to(poses.joint_rotation)
    root = axis_angle_to_matrix(axis) @ poses.joint_rotation[:, 0]
    return BodyPose(torch.cat([root[:, None], poses.joint_rotation[:, 1:]], dim=1), poses.translation)


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
