"""BVH files (Biovision hierarchies) of CMU, Mixamo, MakeHuman, Blender and others, as motion of SMPL's skeleton."""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...files.regular_files import FileError, as_file_error, read_regular
from ..joints import JOINT_NAMES
from .motion import DEFAULT_FPS, LARGEST_NUMBER, Detected, Motion
from .rigs import NAME_BONES, UNMATCHED, BoneMap, map_bones, retarget
from .rotation import about_axis, is_standing, straightness
from .skeleton import REST_JOINTS

LARGEST_BYTES = 64 * 2**20
LONGEST_HIERARCHY = 2**20
MOST_JOINTS = 1000
LONGEST_NUMBER = 40
"""Characters with the space around it: what is much longer than all numbers that are announced holds others."""
MOST_ROTATIONS = 5_000_000
"""Joints times frames: 24 joints for an hour at 60 frames/s, 65 joints for 20 minutes. Files of fewer joints than SMPL
count as SMPL's."""
UNBACKED_ROTATIONS = 1_000_000
"""Joints times frames that a file may have however small it is; beyond, one for each byte. Three angles with the space
around them take at least six, but joints need not have angles."""
LONGEST_FRAME_TIME, SHORTEST_FRAME_TIME = 10.0, 1e-4
"""Seconds."""
_MOST_TRIED = 2000
"""Frames among which a standing one is looked for."""
_CHANNELS = {f"{axis}{kind}": (kind, "XYZ".index(axis)) for axis in "XYZ" for kind in ("position", "rotation")}
_MOTION = re.compile(r"\s*Frames:\s*(\d{1,15})\s+Frame\s+Time:\s*(\S{1,40})", re.IGNORECASE)
_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "decimetres": 0.1}


@dataclasses.dataclass(frozen=True)
class Hierarchy:
    """The skeleton and the channel values of a BVH file."""

    names: list[str]
    """Names of the joints, parents first; an end site is named after its joint with "_end"."""
    parents: list[int]
    """Parent of each joint, -1 for the root."""
    offsets: NDArray[np.float64]
    """From the parent [n, 3], the file's units."""
    channels: list[list[str]]
    """Channels of each joint, in the order of the values, which is also the order of rotations."""
    values: NDArray[np.float64]
    """A row a frame [F, number of channels]."""
    frame_time: float
    """Seconds."""

    def rest(self) -> NDArray[np.float64]:
        """Joints at rest [n, 3]."""
        places = np.array(self.offsets)
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                places[joint] += places[parent]
        return places

    def places(self, turned: NDArray) -> NDArray[np.float64]:
        """Joints [F, n, 3] under rotations in the world [F, n, 3, 3], the root where it is at rest."""
        places = np.tile(self.offsets, (len(turned), 1, 1))
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                places[:, joint] = places[:, parent] + turned[:, parent] @ self.offsets[joint]
        return places

    def world(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotations in the world [F, n, 3, 3] and positions of the root [F, 3].

        Rotations are composed in the order of the channels, the first outermost: R = R_1 R_2 R_3.
        """
        frames, column = len(self.values), 0
        rotations = np.tile(np.eye(3), (frames, len(self.names), 1, 1))
        places = np.tile(self.offsets[0], (frames, 1))
        for joint, channels in enumerate(self.channels):
            for channel in channels:
                kind, axis = _CHANNELS[channel]
                numbers = self.values[:, column]
                column += 1
                if kind == "rotation":
                    rotations[:, joint] = rotations[:, joint] @ about_axis(axis, np.radians(numbers))
                elif joint == 0:
                    places[:, axis] = numbers
            if self.parents[joint] >= 0:
                rotations[:, joint] = rotations[:, self.parents[joint]] @ rotations[:, joint]
        return rotations, places


def read_bvh(path: Path) -> tuple[Motion, NDArray[np.float64]]:
    """The motion of a BVH file on SMPL's skeleton, y up judging by the rest pose, and the rotation [3, 3] from the
    file's axes.

    See `rigs.retarget`. Where the rest is not a pose of a person (as Rokoko writes it, all bones along x), a frame in
    which the person stands with straight limbs takes its place.

    The root's path is scaled by the length of the legs, so feet slide little. Positions of joints other than the
    root are ignored. Raises FileError.
    """
    hierarchy = parse_bvh(path)
    with as_file_error(path, UNMATCHED, NAME_BONES):
        bones = map_bones(name for name in hierarchy.names if not name.endswith("_end"))
    remedy = "export it with a T pose as its first frame"
    with as_file_error(path, "has no rest pose of a human, and no frame in which one stands", remedy):
        return _retarget(hierarchy, bones, path)


def parse_bvh(path: Path) -> Hierarchy:
    """Parse a BVH file. Raises FileError where it is no BVH file or truncated."""
    text = read_regular(path, LARGEST_BYTES).decode("utf-8", errors="replace")
    head, found, tail = text.partition("MOTION")
    if not found or "HIERARCHY" not in head:
        raise FileError(path, "has no HIERARCHY followed by MOTION", "choose a BVH file")
    if len(head) > LONGEST_HIERARCHY:
        reason = f"has a HIERARCHY of more than {LONGEST_HIERARCHY} characters"
        raise FileError(path, reason, "export the motion again")
    try:
        names, parents, offsets, channels = _parse_hierarchy(head.split("HIERARCHY", 1)[1].split())
        values, frame_time = _parse_motion(tail, sum(map(len, channels)), len(names))
    except (ValueError, IndexError, KeyError, OverflowError) as e:
        raise FileError(path, f"is not a complete BVH file ({e!s:.120})", "export the motion again") from e
    if not (np.isfinite(values).all() and np.isfinite(offsets).all()):
        raise FileError(path, "holds NaN or infinite numbers", "export the motion again")
    if max(np.abs(values).max(initial=0), np.abs(offsets).max(initial=0)) > LARGEST_NUMBER:
        reason = f"holds numbers above {LARGEST_NUMBER:g}, which are not angles or lengths"
        raise FileError(path, reason, "export the motion again")
    if not names:
        raise FileError(path, "has no ROOT", "export the motion again")
    return Hierarchy(names, parents, offsets, channels, values, frame_time)


def _parse_hierarchy(words: list[str]) -> tuple[list[str], list[int], NDArray, list[list[str]]]:
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    open_joints: list[int] = []
    at = 0
    while at < len(words):
        word = words[at].upper()
        if word in ("ROOT", "JOINT", "END"):
            brace = words.index("{", at)
            name = " ".join(words[at + 1 : brace]) if word != "END" else f"{names[open_joints[-1]]}_end"
            if word == "ROOT" and names:
                raise ValueError("a second ROOT: one skeleton a file is read")
            if len(names) == MOST_JOINTS:
                raise ValueError(f"more than {MOST_JOINTS} joints")
            parents.append(open_joints[-1] if open_joints else -1)
            names.append(name)
            offsets.append([0.0, 0.0, 0.0])
            channels.append([])
            open_joints.append(len(names) - 1)
            at = brace + 1
        elif word == "OFFSET":
            offsets[open_joints[-1]] = [float(number) for number in words[at + 1 : at + 4]]
            at += 4
        elif word == "CHANNELS":
            count = int(words[at + 1])
            if not 0 <= count <= len(_CHANNELS):
                raise ValueError(f"{count} channels of a joint")
            given = words[at + 2 : at + 2 + count]
            unknown = [channel for channel in given if channel not in _CHANNELS]
            if unknown:
                raise ValueError(f"the channel {unknown[0]!r:.40} is unknown")
            channels[open_joints[-1]] = given
            at += 2 + count
        elif word == "}":
            open_joints.pop()
            at += 1
        else:
            raise ValueError(f"{words[at]!r:.40} where a joint was expected")
    if open_joints:
        raise ValueError("a brace is not closed")
    return names, parents, np.array(offsets, np.float64).reshape(-1, 3), channels


def _parse_motion(text: str, columns: int, joints: int) -> tuple[NDArray[np.float64], float]:
    found = _MOTION.match(text)
    if found is None:
        raise ValueError("MOTION is not followed by Frames: and Frame Time:")
    frames, frame_time = int(found[1]), float(found[2])
    if not columns:
        raise ValueError("no joint has channels")
    rotations, most = frames * max(joints, len(JOINT_NAMES)), min(MOST_ROTATIONS, max(UNBACKED_ROTATIONS, len(text)))
    if rotations > most:
        raise ValueError(f"{frames} frames of {joints} joints are more than {most} rotations, cut the motion")
    if not (frame_time <= 0 or SHORTEST_FRAME_TIME <= frame_time <= LONGEST_FRAME_TIME):
        raise ValueError(f"a frame time of {frame_time:g} s")
    if len(text) - found.end() > LONGEST_NUMBER * frames * columns + LONGEST_HIERARCHY:
        raise ValueError(f"much more than the {frames} frames of {columns} numbers that are announced")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # numpy warns, or newer ones fail, at the first word that is not a number
        try:
            numbers = np.fromstring(text[found.end() :], np.float64, sep=" ")
        except (DeprecationWarning, ValueError) as e:
            raise ValueError("a word where a number was expected") from e
    if frames < 1 or numbers.size < frames * columns:
        raise ValueError(f"{frames} frames of {columns} numbers are announced, but there are {numbers.size} numbers")
    return numbers[: frames * columns].reshape(frames, columns), frame_time


def _retarget(hierarchy: Hierarchy, bones: BoneMap, path: Path) -> tuple[Motion, NDArray[np.float64]]:
    places = hierarchy.rest()
    index = {name: number for number, name in reversed(list(enumerate(hierarchy.names)))}
    tips = {joint: f"{bones.joints[joint]}_end" for joint in ("left_wrist", "right_wrist")}
    tips = {joint: end for joint, end in tips.items() if end in index} | bones.tips
    turned, root = hierarchy.world()
    at_rest = turned
    if not is_standing({joint: places[index[bone]] for joint, bone in bones.joints.items()}):
        frame = _standing_frame(hierarchy, turned, {joint: index[bone] for joint, bone in bones.joints.items()})
        places = hierarchy.places(turned[frame : frame + 1])[0]
        at_rest = turned @ np.swapaxes(turned[frame], -1, -2)
    rest = {name: places[number] for name, number in index.items()}
    turns = {bone: at_rest[:, index[bone]] for bone in bones.joints.values()}
    rotations, from_file = retarget(dataclasses.replace(bones, tips=tips), rest, turns)
    metres, unit = _unit({joint: rest[bone] for joint, bone in bones.joints.items()})
    pelvis = _pelvis(hierarchy, turned, root, index[bones.joints["pelvis"]]) @ from_file.T
    stated = 1 / hierarchy.frame_time if hierarchy.frame_time > 0 else 0.0
    detected = Detected(bones.rig, "y", f"{unit} (1 = {metres:.4g} m)", stated, bones.joints, average_legs=True)
    moved = pelvis * metres - REST_JOINTS[0]
    return Motion(rotations, moved, stated or DEFAULT_FPS, path.stem, detected), from_file


def _standing_frame(hierarchy: Hierarchy, turned: NDArray, joints: Mapping[str, int]) -> int:
    """The frame in which a person stands with the straightest limbs. Raises ValueError where none stands."""
    chosen = np.unique(np.linspace(0, len(turned) - 1, min(len(turned), _MOST_TRIED)).astype(int))
    places = hierarchy.places(turned[chosen])
    heads = {joint: places[:, number] for joint, number in joints.items()}
    if not is_standing(heads).any():
        raise ValueError("the shoulders are never above the hips, and these above the ankles")
    return int(chosen[np.where(is_standing(heads), straightness(heads), -1.0).argmax()])


def _pelvis(hierarchy: Hierarchy, turned: NDArray, root: NDArray, pelvis: int) -> NDArray[np.float64]:
    """Positions of the pelvis [F, 3], which may not be the root."""
    chain = []
    while pelvis > 0:
        chain.append(pelvis)
        pelvis = hierarchy.parents[pelvis]
    place = np.array(root)
    for joint in reversed(chain):
        place += turned[:, hierarchy.parents[joint]] @ hierarchy.offsets[joint]
    return place


def _unit(heads: dict[str, NDArray]) -> tuple[float, str]:
    """Length of a unit of the file in metres, if the legs are average, and the name of the nearest unit."""

    def leg(place: dict[str, NDArray]) -> float:
        lengths = [
            np.linalg.norm(place[f"{side}_{a}"] - place[f"{side}_{b}"])
            for side in ("left", "right")
            for a, b in (("hip", "knee"), ("knee", "ankle"))
        ]
        return float(sum(lengths))

    length = leg(heads)
    if not length > 0:
        raise ValueError("the legs have no length: this is not a rest pose of a person")
    metres = leg(dict(zip(JOINT_NAMES, REST_JOINTS, strict=True))) / length
    nearest = min(_UNITS, key=lambda name: abs(np.log(_UNITS[name] / metres)))
    return metres, nearest if abs(np.log(_UNITS[nearest] / metres)) < 0.4 else "a unit of its own"
