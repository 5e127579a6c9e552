"""People and poses as assets, with pictures that the child draws; the built-in poses as an asset library."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..motion.pose_library import builtin_poses, current_pose
from ..motion.poses import grounding
from ..motion.rotation import from_axis_angle, to_axis_angle
from ..motion.skeleton import REST_JOINTS, joint_positions
from ..places import own_folder
from ..scene.armature import build_armature
from ..scene.convention import points_to_blender
from ..scene.files import person_file
from ..scene.human import MARK, armature_of
from ..scene.keyframes import keyframe_poses
from .job import Job
from .target import Target
from .thumbnails import SIDE, clay_figure, picture_of_file, show

POSE_TAG, HUMAN_TAG = "pose", "human"


def mark(asset: bpy.types.ID, description: str, tags: Iterable[str], picture: NDArray) -> None:
    """Make a data-block an asset, or update its description. Raises ValueError for one that is linked."""
    if asset.library is not None:
        raise ValueError(f"{asset.name!r} is linked from {asset.library.filepath!r}: mark it as an asset there")
    asset.asset_mark()
    about = asset.asset_data
    about.description = description
    for tag in tags:
        about.tags.new(tag, skip_if_exists=True)
    show(asset, picture)


def human_words(person: bpy.types.Collection) -> tuple[str, list[str]]:
    """Description and tags of a person: their seed, and what they were asked to be."""
    try:
        made = json.loads(person[MARK])
    except (ValueError, TypeError):
        made = {}
    asked = made.get("attributes") or {}
    said = ", ".join(f"{name} {value}" for name, value in asked.items())
    seed = f"seed {made['seed']}" if "seed" in made else "no seed"
    description = f"Generated person, {seed}" + (f", asked to be: {said}" if said else "")
    return description, [HUMAN_TAG, *(str(value) for value in asked.values() if isinstance(value, str))]


def pose_action(armature: bpy.types.Object, rotations: NDArray, translation: NDArray, name: str) -> bpy.types.Action:
    """A pose as Blender's pose library wants it: an action with one key of every bone, at frame 1.

    The armature keeps the action it has. Rotations [24, 3, 3] and translation [3] as for `keyframe_poses`.
    """
    had = armature.animation_data is not None
    animation = armature.animation_data_create()
    action, slot = animation.action, animation.action_slot
    try:
        made = keyframe_poses(armature, np.ones(1), rotations[None], translation[None], name)
    finally:
        animation.action = action
        if action is not None:
            animation.action_slot = slot
        if not had:
            armature.animation_data_clear()
    return made


_PICTURE = "asset.png"
_ARMS_DOWN = 1.15
"""Radians from the T pose: people fill their picture better so."""


@dataclasses.dataclass(frozen=True)
class HumanAssetJob(Job):
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
class PoseAssetJob(Job):
    """The pose that the person has when the job is queued becomes an action and an asset."""

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
    def of(cls, person: bpy.types.Collection, name: str) -> PoseAssetJob:
        """Raises ValueError for a rig that lacks the bones."""
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


LIBRARY = "PrimDiffusion"
"""What the asset library is called in the preferences."""
FILE = "poses.blend"


def write_pose_library(context: bpy.types.Context, folder: Path | None = None) -> tuple[Path, int]:
    """Write FILE into `folder`, which becomes an asset library; returns its path and the number of poses.

    The open file is as before. Raises OSError where it cannot be written.
    """
    folder = folder if folder is not None else own_folder() / "assets"
    folder.mkdir(parents=True, exist_ok=True)
    path, unfinished = folder / FILE, folder / f".{FILE}"
    armature = build_armature("PrimDiffusion Poses", points_to_blender(REST_JOINTS))
    context.scene.collection.objects.link(armature)  # only what is in a scene has a pose
    actions: set[bpy.types.Action] = set()
    try:
        context.view_layer.update()
        for name, vectors in builtin_poses().items():
            actions.add(_asset(armature, name, from_axis_angle(vectors)))
        bpy.data.libraries.write(str(unfinished), actions, fake_user=True, compress=True)
        os.replace(unfinished, path)
    except RuntimeError as error:
        raise OSError(f"{path} could not be written: {error}") from error
    finally:
        unfinished.unlink(missing_ok=True)
        data = armature.data
        bpy.data.batch_remove([*actions, armature, data])
    _add_library(folder)
    return path, len(builtin_poses())


def _asset(armature: bpy.types.Object, name: str, rotations: np.ndarray) -> bpy.types.Action:
    place = grounding(rotations[None])
    title = name[:1].upper() + name[1:]
    action = pose_action(armature, rotations, place[0], title)
    figure = clay_figure(joint_positions(rotations[None], place)[0])
    mark(action, f"{title}, a built-in pose", [POSE_TAG, "built-in"], figure)
    return action


def _add_library(folder: Path) -> None:
    libraries = bpy.context.preferences.filepaths.asset_libraries
    if not any(Path(library.path) == folder for library in libraries if library.path):
        libraries.new(name=LIBRARY, directory=str(folder))
