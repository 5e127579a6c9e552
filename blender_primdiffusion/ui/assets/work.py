"""Assets whose pictures the child draws."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...formats.joints import JOINT_NAMES
from ...motion.pose_library import current_pose
from ...motion.rotation import to_axis_angle
from ...scene.files import person_file
from ...scene.human import armature_of
from ..jobs.target import Target
from ..jobs.work import Work
from .marking import POSE_TAG, human_words, mark, pose_action
from .thumbnails import SIDE, picture_of_file

_PICTURE = "asset.png"
_ARMS_DOWN = 1.15
"""Radians from the T pose: people fill their picture better so."""


@dataclasses.dataclass(frozen=True)
class HumanAssetWork(Work):
    """A person becomes an asset once the picture is there."""

    kind = "human_asset"
    method = "render"
    undo = "Mark Human as Asset"

    target: Target

    @property
    def label(self) -> str:
        """For people."""
        return f"Picture of {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        """Arms down, from the front."""
        pose = np.zeros((len(JOINT_NAMES), 3))
        pose[JOINT_NAMES.index("left_shoulder"), 2] = -_ARMS_DOWN
        pose[JOINT_NAMES.index("right_shoulder"), 2] = _ARMS_DOWN
        return _drawing(self.target.found(), pose, folder)

    def finish(self, context: bpy.types.Context, result: dict[str, Any], folder: Path) -> str:
        """Mark the collection."""
        return mark_human(self.target.found(), folder / _PICTURE)


@dataclasses.dataclass(frozen=True)
class PoseAssetWork(Work):
    """The pose somebody has when the work begins becomes an action and an asset."""

    kind = "pose_asset"
    method = "render"
    undo = "Mark Pose as Asset"

    target: Target
    name: str
    rotations: tuple
    """[24][3][3]."""
    translation: tuple
    """[3]."""

    @classmethod
    def of(cls, person: bpy.types.Collection, name: str) -> PoseAssetWork:
        """Raises ValueError for somebody without the bones."""
        rotations, translation = current_pose(armature_of(person))
        frozen = tuple(tuple(map(tuple, rows)) for rows in rotations.tolist())
        return cls(Target.of(person), name, frozen, tuple(translation.tolist()))

    @property
    def label(self) -> str:
        """For people."""
        return f"Picture of the pose {self.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        """The person in the pose, from the front."""
        return _drawing(self.target.found(), to_axis_angle(np.array(self.rotations)), folder)

    def finish(self, context: bpy.types.Context, result: dict[str, Any], folder: Path) -> str:
        """Make the action and mark it."""
        return self.marked(folder / _PICTURE)

    def marked(self, picture: Path) -> str:
        """The action of the pose, an asset with this picture; returns the news. Raises OSError, ValueError."""
        pixels = picture_of_file(picture)
        armature = armature_of(self.target.found())
        action = pose_action(armature, np.array(self.rotations), np.array(self.translation), self.name)
        mark(action, f"Pose of {self.target.name}", [POSE_TAG, self.target.name], pixels)
        return f"The pose {action.name} is an asset now; save the file in a folder of your asset libraries"


def mark_human(person: bpy.types.Collection, picture: Path) -> str:
    """Make a person an asset with a picture; returns the news. Raises OSError, ValueError."""
    mark(person, *human_words(person), picture_of_file(picture))
    return f"{person.name} is an asset now; save the file in a folder of your asset libraries"


def _drawing(person: bpy.types.Collection, pose: np.ndarray, folder: Path) -> dict[str, Any]:
    """Of the child's method `render`."""
    sides = {"width": SIDE, "height": SIDE}
    return {"human": str(person_file(person)), "out": str(folder / _PICTURE), "pose": pose.ravel().tolist(), **sides}
