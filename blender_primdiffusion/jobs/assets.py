"""Humans and poses as assets with preview images, and the built-in poses as an asset library."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.answers import RenderAnswer
from ..formats.joints import JOINT_NAMES, PARENTS
from ..formats.poses.rotation import from_axis_angle, to_axis_angle
from ..formats.poses.skeleton import REST_JOINTS, joint_positions
from ..formats.regular_files import check_regular
from ..formats.whole_files import written_whole
from ..motion.pose_library import builtin_poses, current_pose
from ..motion.poses import grounding
from ..places import own_folder
from ..scene.armature import build_armature, keyframe_poses
from ..scene.blend_values import as_shown
from ..scene.convention import points_to_blender
from ..scene.human import provenance_of
from ..scene.payload import session_file
from .queue import Job
from .target import HumanTarget

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


def asset_description(person: bpy.types.Object) -> tuple[str, list[str]]:
    """Description and tags of a human: its seed and attributes."""
    made = provenance_of(person)
    asked = made.get("attributes")
    asked = asked if isinstance(asked, dict) else {}
    said = ", ".join(f"{as_shown(name)} {as_shown(value)}" for name, value in asked.items())
    seed = f"seed {as_shown(made['seed'])}" if "seed" in made else "no seed"
    description = f"Generated human, {seed}" + (f", {said}" if said else "")
    return description, [HUMAN_TAG, *(as_shown(value) for value in asked.values() if isinstance(value, str))]


def pose_action(armature: bpy.types.Object, rotations: NDArray, translation: NDArray, name: str) -> bpy.types.Action:
    """A pose for Blender's pose library: an action with one key of every bone, at frame 1.

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
"""Radians from the T pose, so that a human fills the picture."""


@dataclasses.dataclass(frozen=True)
class HumanAssetJob(Job):
    """Draw a picture, then mark the human as an asset."""

    kind = "human_asset"
    method = "render"
    undo = "Mark Human as Asset"

    target: HumanTarget

    @property
    def label(self) -> str:
        return f"Picture of {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        pose = np.zeros((len(JOINT_NAMES), 3))
        pose[JOINT_NAMES.index("left_shoulder"), 2] = -_ARMS_DOWN
        pose[JOINT_NAMES.index("right_shoulder"), 2] = _ARMS_DOWN
        return _drawing(self.target.found(), pose, folder)

    def finish(self, context: bpy.types.Context, result: RenderAnswer, folder: Path) -> str:
        return mark_human(self.target.found(), folder / _PICTURE)


@dataclasses.dataclass(frozen=True)
class PoseAssetJob(Job):
    """Save the pose that the human has when the job is queued as an action, and mark it as an asset."""

    kind = "pose_asset"
    method = "render"
    undo = "Mark Pose as Asset"

    target: HumanTarget
    name: str
    rotations: tuple
    """[24][3][3]."""
    translation: tuple
    """[3]."""

    @classmethod
    def of(cls, person: bpy.types.Object, name: str) -> PoseAssetJob:
        """Raises ValueError for a rig that lacks the bones."""
        rotations, translation = current_pose(person)
        frozen = tuple(tuple(map(tuple, rows)) for rows in rotations.tolist())
        return cls(HumanTarget.of(person), name, frozen, tuple(translation.tolist()))

    @property
    def label(self) -> str:
        return f"Picture of the pose {self.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        return _drawing(self.target.found(), to_axis_angle(np.array(self.rotations)), folder)

    def finish(self, context: bpy.types.Context, result: RenderAnswer, folder: Path) -> str:
        return self.marked(folder / _PICTURE)

    def marked(self, picture: Path) -> str:
        """Mark the pose's action as an asset with this picture; returns a message. Raises OSError, ValueError."""
        pixels = picture_of_file(picture)
        armature = self.target.found()
        action = pose_action(armature, np.array(self.rotations), np.array(self.translation), self.name)
        mark(action, f"Pose of {self.target.name}", [POSE_TAG, self.target.name], pixels)
        return f"The pose {action.name} is an asset now; save the file in a folder of your asset libraries"


def mark_human(person: bpy.types.Object, picture: Path) -> str:
    """Mark a human as an asset with this picture; returns a message. Raises OSError, ValueError."""
    mark(person, *asset_description(person), picture_of_file(picture))
    return f"{person.name} is an asset now; save the file in a folder of your asset libraries"


def _drawing(person: bpy.types.Object, pose: np.ndarray, folder: Path) -> dict[str, Any]:
    """Parameters of the child's method `render`."""
    sides = {"width": SIDE, "height": SIDE}
    human = str(session_file(person))
    return {"human": human, "out": str(folder / _PICTURE), "pose": pose.ravel().tolist(), **sides}


LIBRARY = "PrimDiffusion"
"""Name of the asset library in the preferences."""
FILE = "poses.blend"


def write_pose_library(context: bpy.types.Context, folder: Path | None = None) -> tuple[Path, int]:
    """Write FILE into `folder`, which becomes an asset library; returns its path and the number of poses.

    The open file is as before. Raises OSError where it cannot be written.
    """
    folder = folder if folder is not None else own_folder() / "assets"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FILE
    armature = build_armature("PrimDiffusion Poses", points_to_blender(REST_JOINTS))
    context.scene.collection.objects.link(armature)  # objects in no scene have no pose
    actions: set[bpy.types.Action] = set()
    try:
        context.view_layer.update()
        for name, vectors in builtin_poses().items():
            actions.add(_asset(armature, name, from_axis_angle(vectors)))
        with written_whole(path) as unfinished:
            bpy.data.libraries.write(str(unfinished), actions, fake_user=True, compress=True)
    except RuntimeError as error:
        raise OSError(f"{path} could not be written: {error}") from error
    finally:
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


SIDE = 256
"""Pixels a side, as in Blender's own previews."""
_THICK_M = {"pelvis": 0.11, "spine1": 0.12, "spine2": 0.12, "spine3": 0.12, "neck": 0.055, "head": 0.1, "collar": 0.07}
_LIMB_M = {"hip": 0.09, "knee": 0.075, "ankle": 0.05, "foot": 0.04, "shoulder": 0.06, "elbow": 0.045, "wrist": 0.035}
_THIN_M = 0.035
_ALONG = np.linspace(0.0, 1.0, 32)
_SKULL_M = 0.09
"""From the head joint to the middle of the skull."""
_CLAY, _FRAME_M = np.array([0.80, 0.62, 0.50]), 2.2
_YAW = np.deg2rad(25.0)
_LIGHT = np.array([-0.35, 0.65, 0.67])


def show(asset: bpy.types.ID, picture: NDArray) -> None:
    """Give an asset its preview: RGBA [SIDE, SIDE, 4] from 0 to 1, straight alpha, bottom row first."""
    preview = asset.preview_ensure()
    preview.image_size = picture.shape[1::-1]
    preview.image_pixels_float.foreach_set(np.ascontiguousarray(picture, np.float32).ravel())


def picture_of_file(path: Path) -> NDArray[np.float32]:
    """An image file as a picture for `show`: padded to a square, then scaled. Raises OSError for no image."""
    try:
        check_regular(path)  # Blender would wait for a pipe
        image = bpy.data.images.load(str(path))
    except (RuntimeError, OSError) as error:
        raise OSError(f"{path} cannot be read as a picture: choose a PNG or JPEG") from error
    try:
        width, height = image.size
        if not (width and height):
            raise OSError(f"{path} cannot be read as a picture: choose a PNG or JPEG")
        side = max(width, height)
        image.scale(max(1, width * SIDE // side), max(1, height * SIDE // side))
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    picture = np.zeros((SIDE, SIDE, 4), np.float32)
    x, y = (SIDE - width) // 2, (SIDE - height) // 2
    picture[y : y + height, x : x + width] = pixels.reshape(height, width, 4)
    return picture


def clay_figure(joints: NDArray) -> NDArray[np.float32]:
    """A figure with joints at [24, 3] (y up, metres, facing +z), seen from the front and a little from the side.

    Balls along the bones, the nearest of each pixel, lit from above: a picture as `show` wants it.
    """
    turn = np.array([[np.cos(_YAW), 0, np.sin(_YAW)], [0, 1, 0], [-np.sin(_YAW), 0, np.cos(_YAW)]])
    centres, radii = _balls(joints @ turn.T)
    middle = (centres.min(0) + centres.max(0)) / 2
    frame = max(_FRAME_M, 1.1 * np.ptp(centres[:, :2], axis=0).max())
    grid = ((np.arange(SIDE) + 0.5) / SIDE - 0.5) * frame
    depth = np.full((SIDE, SIDE), -np.inf)
    light = np.zeros((SIDE, SIDE))
    for centre, radius in zip(centres, radii, strict=True):
        around = (abs(grid + middle[1] - centre[1]) < radius), (abs(grid + middle[0] - centre[0]) < radius)
        window = np.ix_(*around)
        y = (grid[around[0]] + middle[1] - centre[1])[:, None]
        x = (grid[around[1]] + middle[0] - centre[0])[None, :]
        bulge = radius**2 - x**2 - y**2
        z = np.sqrt(np.maximum(bulge, 0.0))
        nearer = (bulge > 0) & (centre[2] + z > depth[window])
        lit = 0.25 + 0.75 * np.clip((x * _LIGHT[0] + y * _LIGHT[1] + z * _LIGHT[2]) / radius, 0, 1)
        depth[window] = np.where(nearer, centre[2] + z, depth[window])
        light[window] = np.where(nearer, lit, light[window])
    picture = np.zeros((SIDE, SIDE, 4), np.float32)
    picture[..., :3] = light[..., None] * _CLAY
    picture[..., 3] = np.isfinite(depth)
    return picture


def _balls(joints: NDArray) -> tuple[NDArray, NDArray]:
    centres, radii = [], []
    for child, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        thick = _radius(JOINT_NAMES[parent]), _radius(JOINT_NAMES[child])
        centres.append(joints[parent] * (1 - _ALONG[:, None]) + joints[child] * _ALONG[:, None])
        radii.append(thick[0] * (1 - _ALONG) + thick[1] * _ALONG)
    head, neck = joints[JOINT_NAMES.index("head")], joints[JOINT_NAMES.index("neck")]
    up = (head - neck) / max(float(np.linalg.norm(head - neck)), 1e-9)
    centres.append((head + up * _SKULL_M)[None])
    radii.append(np.array([0.11]))
    return np.concatenate(centres), np.concatenate(radii)


def _radius(joint: str) -> float:
    return _THICK_M.get(joint) or _THICK_M.get(joint.partition("_")[2]) or _LIMB_M.get(joint.partition("_")[2], _THIN_M)
