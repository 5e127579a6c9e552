"""Motion put onto armatures and read back from them, and what fits it to them: frame rate, range, place, floor, and
length of the path for other legs."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..formats.poses.motion import Motion
from ..formats.poses.rotation import from_quaternion, matrix_to_quaternion, nearest, slerp
from ..formats.poses.skeleton import REST_JOINTS, joint_positions, unchain
from ..scene.actions import posed_on
from ..scene.armature import keyframe_poses, model_origin, rest_rotations
from ..scene.blend_values import stored_numbers
from ..scene.convention import BLENDER_FROM_BACKEND, continuous_quaternions, points_to_backend
from ..scene.handles import check_no_handles
from ..scene.human import BETA_COUNT, BETAS
from .poses import check_posable, rest_joints

_FEET = [JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in ("ankle", "foot")]
_STANDING_SHARE = 5.0
"""Percentile of the heights of feet that counts as the floor: single frames may dip below it."""
_TRAVEL = 0.5
"""Least length of the path, metres, from which feet are evaluated."""
_STILL = 0.1
"""Speed at which a foot counts as half still, m/s."""
_STANDING = 0.5
"""Least share of the time for which a foot must stand; on skates or treadmills it does not."""
_FACTORS = np.arange(0.6, 1.6001, 0.02)
_FINEST = 0.002
_AS_IT_IS = 0.03
"""Factors nearer to 1 count as 1: rolling heels and bending knees look like other legs."""
_RATE = 25.0
"""Samples per second: between frames of a fast camera, feet move less than their noise."""
_MOST_SAMPLES = 3000
"""The first samples of longer motions are enough."""


def cut(motion: Motion, first: int = 1, last: int = 0) -> Motion:
    """The frames `first` to `last` of the file, inclusive, counted from 1; 0 is the last one.

    Raises ValueError where no frame is left.
    """
    end = len(motion) if last <= 0 else min(last, len(motion))
    if not 1 <= first <= end:
        raise ValueError(f"there are no frames {first} to {last or end} in {len(motion)} frames: choose existing ones")
    return motion.frames(np.arange(first - 1, end))


def resample(motion: Motion, fps: float) -> Motion:
    """The same motion at another frame rate; rotations are interpolated by slerp, translations linearly.

    The last frame is the last one within the motion's duration.
    """
    if len(motion) < 2 or abs(motion.fps - fps) < 1e-9 * fps:
        return dataclasses.replace(motion, fps=fps)
    seconds = (len(motion) - 1) / motion.fps
    at = np.arange(int(np.floor(seconds * fps + 1e-6)) + 1) / fps * motion.fps
    before = np.minimum(at.astype(np.int64), len(motion) - 2)
    share = np.clip(at - before, 0.0, 1.0)
    turns = continuous_quaternions(matrix_to_quaternion(motion.rotations))
    rotations = from_quaternion(slerp(turns[before], turns[before + 1], share[:, None, None]))
    moved = motion.translations
    places = moved[before] + share[:, None] * (moved[before + 1] - moved[before])
    return dataclasses.replace(motion, rotations=rotations, translations=places, fps=fps)


def rounds_of(motion: Motion, rounds: int) -> Motion:
    """The motion `rounds` times, each from where the one before has ended, in the direction in which it has ended.

    The last frame is the next round's first, so it must be the first frame turned about the vertical and moved.
    """
    turn = motion.rotations[-1, 0] @ motion.rotations[0, 0].T
    turned, place, rotations, places = np.eye(3), motion.translations[0], [], []
    for number in range(rounds):
        following = np.array(motion.rotations)
        following[:, 0] = turned @ following[:, 0]
        path = place + (motion.translations - motion.translations[0]) @ turned.T
        rotations.append(following[number > 0 :])
        places.append(path[number > 0 :])
        turned, place = turn @ turned, path[-1]
    return dataclasses.replace(motion, rotations=np.concatenate(rotations), translations=np.concatenate(places))


def scale_places(motion: Motion, factor: float) -> Motion:
    """The motion with its translations scaled."""
    return dataclasses.replace(motion, translations=motion.translations * factor)


def in_place(motion: Motion) -> Motion:
    """The motion without horizontal translation."""
    return dataclasses.replace(motion, translations=motion.translations * [0.0, 1.0, 0.0])


def from_origin(motion: Motion) -> Motion:
    """The motion with a path that begins at the origin; heights stay."""
    start = motion.translations[0] * [1.0, 0.0, 1.0]
    return dataclasses.replace(motion, translations=motion.translations - start)


def on_floor(motion: Motion, rest: NDArray = REST_JOINTS) -> Motion:
    """The whole motion raised or lowered, so that its lowest feet are at the height of those of `rest` [24, 3].

    Jumps remain. For a person who never stands (a swimmer) the result means little.
    """
    heights = joint_positions(motion.rotations, motion.translations, rest)[:, _FEET, 1] - rest[_FEET, 1]
    lowest = heights.min(-1)
    floor = float(np.percentile(lowest, _STANDING_SHARE)) if len(lowest) > 1 else float(lowest[0])
    return dataclasses.replace(motion, translations=motion.translations - [0.0, floor, 0.0])


def leg_ratio(rest: NDArray) -> float:
    """Length of the legs of a rest skeleton [24, 3], relative to the average skeleton."""
    return _legs(rest) / _legs(REST_JOINTS)


def stride_ratio(motion: Motion, rest: NDArray) -> float | None:
    """The factor on a motion's translations at which the feet of a rest skeleton [24, 3] slide least.

    For motions scaled to average legs it is the ratio of the legs. The legs behind other motions are unknown (AMASS'
    betas refer to bodies under a licence of their own) but follow from the feet: in a walk, at any time an ankle or a
    ball of the foot stands still if the path fits the legs. None where the path is short or no factor makes feet stand.
    """
    if motion.detected.average_legs:
        return leg_ratio(rest)
    samples = slice(0, None, max(1, round(motion.fps / _RATE)))
    rate = motion.fps / samples.step
    rotations, places = (array[samples][:_MOST_SAMPLES] for array in (motion.rotations, motion.translations))
    feet = np.diff(joint_positions(rotations, None, rest)[:, _FEET], axis=0) * rate
    path = np.diff(places, axis=0)
    if np.linalg.norm(path[:, [0, 2]], axis=-1).sum() < _TRAVEL:
        return None
    path = path[:, None] * rate

    def sliding(factor: float) -> float:
        square = ((feet + factor * path) ** 2).sum(-1).min(-1)
        return float((square / (square + _STILL**2)).mean())

    best = min(_FACTORS, key=sliding)
    near = np.arange(best - _FACTORS[1] + _FACTORS[0], best + _FACTORS[1] - _FACTORS[0], _FINEST)
    best = float(min(near, key=sliding))
    if not _FACTORS[0] < best < _FACTORS[-1] or sliding(best) > 1 - _STANDING:
        return None
    return 1.0 if abs(best - 1) < _AS_IT_IS else best


def _legs(rest: NDArray) -> float:
    ways = (("hip", "knee"), ("knee", "ankle"))
    ends = [(JOINT_NAMES.index(f"{s}_{a}"), JOINT_NAMES.index(f"{s}_{b}")) for s in ("left", "right") for a, b in ways]
    return float(sum(np.linalg.norm(rest[a] - rest[b]) for a, b in ends))


@dataclasses.dataclass(frozen=True)
class Placement:
    """How a motion is to be put onto an armature."""

    start: float = 1.0
    """Frame of the first key."""
    first: int = 1
    """Frame of the motion, counted from 1."""
    last: int = 0
    """The same; 0 is the last there is."""
    fit_stride: bool = True
    """Whether the path is scaled to the armature's legs."""
    root: str = "ORIGIN"
    """ORIGIN: the path begins at the human; KEEP: it stays as in the file; PLACE: the human stays in place."""
    ground: bool = True
    """Whether the whole motion is moved onto the floor."""


def place_motion(
    context: bpy.types.Context, armature: bpy.types.Object, motion: Motion, how: Placement
) -> tuple[float, float]:
    """Key the motion in a new action, on every frame of the scene; returns the first and last frame.

    Raises ValueError before anything is changed.
    """
    check_posable(armature)
    check_no_handles(armature)
    rest = rest_joints(armature)
    ratio = stride_ratio(motion, rest) if how.fit_stride else None
    fitted = fit(motion, rest, scene_fps(context.scene), how, 1.0 if ratio is None else ratio)
    frames = how.start + np.arange(len(fitted))
    keyframe_poses(armature, frames, fitted.rotations, fitted.translations, motion.name).use_fake_user = True
    return float(frames[0]), float(frames[-1])


def fit(motion: Motion, rest: NDArray, scene_rate: float, how: Placement, scale: float) -> Motion:
    """The motion, with a frame for each of the scene's, on a skeleton at rest [24, 3]; `scale` is for its path."""
    fitted = scale_places(resample(cut(motion, how.first, how.last), scene_rate), scale)
    if how.root != "KEEP":
        fitted = in_place(fitted) if how.root == "PLACE" else from_origin(fitted)
    return on_floor(fitted, rest) if how.ground else fitted


def scene_fps(scene: bpy.types.Scene) -> float:
    """Frames per second, such as 23.976."""
    return scene.render.fps / scene.render.fps_base


def extend_range(scene: bpy.types.Scene, last: float) -> None:
    """Extend the scene to the end of the motion."""
    scene.frame_end = max(scene.frame_end, int(np.ceil(last)))


def sample_motion(
    context: bpy.types.Context, armature: bpy.types.Object, frames: range
) -> tuple[Motion, NDArray[np.float64], NDArray[np.float64]]:
    """The motion on some frames in the armature's own space, the shape [n], the rest pelvis [3].

    The object's own transform is left out. Raises ValueError where one of SMPL's joints is missing.
    """
    rest, pelvis = rest_rotations(armature), rest_joints(armature)[0]
    shown = posed_on(context, armature, frames)
    bones = np.array([[np.array(one.pose.bones[name].matrix) for name in JOINT_NAMES] for one in shown], np.float64)
    world = nearest(bones[..., :3, :3]) @ np.swapaxes(rest, -1, -2)
    world = BLENDER_FROM_BACKEND.T @ world @ BLENDER_FROM_BACKEND
    places = points_to_backend(bones[:, 0, :3, 3] - model_origin(armature.data)) - pelvis
    motion = Motion(unchain(world), places, scene_fps(context.scene), armature.name)
    return motion, np.array(stored_numbers(armature, BETAS, BETA_COUNT) or [0.0] * BETA_COUNT), pelvis
