"""Humans that stand together on a floor, in front of the same cameras.

Each is captured alone, as any subject; annotations put those of a group into one image. So a human who is partly hidden
has a whole mask too.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float

from primdiffusion.body.model import BodyPose
from primdiffusion.capture.reader import Captures, Subject
from primdiffusion.formats.group_places import MOST
from primdiffusion.geometry.rotation import axis_angle_to_matrix


def turned(poses: BodyPose, yaw: Float[np.ndarray, "F"]) -> BodyPose:
    """Turn the poses [F] about the vertical through the pelvis, radians."""
    axis = torch.from_numpy(np.stack([0 * yaw, yaw, 0 * yaw], axis=-1)).to(poses.joint_rotation)
    root = axis_angle_to_matrix(axis) @ poses.joint_rotation[:, 0]
    return BodyPose(torch.cat([root[:, None], poses.joint_rotation[:, 1:]], dim=1), poses.translation)


def groups(captures: Captures) -> list[tuple[Subject, ...]]:
    """The finished subjects of each image: those with the same cameras if they stand together, else each alone."""
    if captures.about.get("together") is None:
        return [(captures.subject(name),) for name in captures.subjects]
    found: dict[object, list[Subject]] = {}
    for subject in map(captures.subject, captures.subjects):
        cameras = [
            (*array.round(4).ravel().tolist(), view.width, view.height)
            for view in subject.views
            for array in (view.intrinsics, view.rotation, view.translation)
        ]
        found.setdefault((subject.frames, *cameras), []).append(subject)
    return [
        tuple(members[first : first + MOST]) for members in found.values() for first in range(0, len(members), MOST)
    ]
