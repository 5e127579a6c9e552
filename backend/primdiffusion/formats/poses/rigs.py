"""Other rigs as SMPL's skeleton: which bone is which joint, and how the rest pose differs from SMPL's T."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from ..joints import JOINT_NAMES, PARENTS
from .rotation import about_axis, between, is_standing
from .skeleton import REST_JOINTS, unchain

_SIDED = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist", "hand")
RIGS: dict[str, dict[str, str]] = {
    "SMPL": {name: name for name in ("pelvis", "spine1", "spine2", "spine3", "neck", "head")}
    | {part: f"{{left}}{part}" for part in _SIDED},
    "SMPL, short": {name: name for name in ("pelvis", "spine1", "spine2", "spine3", "neck", "head")}
    | {part: f"{{l}}{part}" for part in _SIDED},
    "Mixamo": {
        "pelvis": "hips", "hip": "{left}upleg", "knee": "{left}leg", "ankle": "{left}foot", "foot": "{left}toebase",
        "spine1": "spine", "spine2": "spine1", "spine3": "spine2", "neck": "neck", "head": "head",
        "collar": "{left}shoulder", "shoulder": "{left}arm", "elbow": "{left}forearm", "wrist": "{left}hand",
        "tip": "{left}handmiddle1",
    },
    "CMU": {
        "pelvis": "hips", "hip": "{left}upleg", "knee": "{left}leg", "ankle": "{left}foot", "foot": "{left}toebase",
        "spine1": "lowerback", "spine2": "spine", "spine3": "spine1", "neck": "neck|neck1", "head": "head",
        "collar": "{left}shoulder", "shoulder": "{left}arm", "elbow": "{left}forearm", "wrist": "{left}hand",
        "tip": "{left}handindex1",
    },
    "Unreal": {
        "pelvis": "pelvis", "hip": "thigh{l}", "knee": "calf{l}", "ankle": "foot{l}", "foot": "ball{l}",
        "spine1": "spine01", "spine2": "spine02", "spine3": "spine05|spine04|spine03", "neck": "neck01", "head": "head",
        "collar": "clavicle{l}", "shoulder": "upperarm{l}", "elbow": "lowerarm{l}", "wrist": "hand{l}",
        "tip": "middle01{l}",
    },
    "RenderPeople": {
        "pelvis": "hip|hips|pelvis", "hip": "upperleg{l}", "knee": "lowerleg{l}", "ankle": "foot{l}", "foot": "ball{l}",
        "spine1": "spine01", "spine2": "spine02", "spine3": "spine03", "neck": "neck|neck01", "head": "head",
        "collar": "shoulder{l}", "shoulder": "upperarm{l}", "elbow": "lowerarm{l}", "wrist": "hand{l}",
        "tip": "middle01{l}|finger301{l}",
    },
    "Rigify": {
        "pelvis": "spine", "hip": "thigh{l}", "knee": "shin{l}", "ankle": "foot{l}", "foot": "toe{l}",
        "spine1": "spine001", "spine2": "spine002", "spine3": "spine003", "neck": "spine004", "head": "spine006",
        "collar": "shoulder{l}", "shoulder": "upperarm{l}", "elbow": "forearm{l}", "wrist": "hand{l}",
        "tip": "fmiddle01{l}",
    },
    "MakeHuman": {
        "pelvis": "root", "hip": "upperleg01{l}", "knee": "lowerleg01{l}", "ankle": "foot{l}", "foot": "toe31{l}",
        "spine1": "spine04", "spine2": "spine03", "spine3": "spine02|spine01", "neck": "neck01", "head": "head",
        "collar": "clavicle{l}", "shoulder": "upperarm01{l}", "elbow": "lowerarm01{l}", "wrist": "wrist{l}",
        "tip": "finger31{l}",
    },
    "Biped": {
        "pelvis": "pelvis", "hip": "{l}thigh", "knee": "{l}calf", "ankle": "{l}foot", "foot": "{l}toe0",
        "spine1": "spine", "spine2": "spine1", "spine3": "spine2", "neck": "neck", "head": "head",
        "collar": "{l}clavicle", "shoulder": "{l}upperarm", "elbow": "{l}forearm", "wrist": "{l}hand",
        "tip": "{l}finger2",
    },
    "Daz": {
        "pelvis": "hip", "hip": "{l}thigh", "knee": "{l}shin", "ankle": "{l}foot", "foot": "{l}toe",
        "spine1": "abdomen", "spine3": "chest", "neck": "neck", "head": "head",
        "collar": "{l}collar", "shoulder": "{l}shldr", "elbow": "{l}forearm", "wrist": "{l}hand",
        "tip": "{l}mid1",
    },
    "Biovision": {
        "pelvis": "hips", "hip": "{left}hip|{left}upleg", "knee": "{left}knee|{left}lowleg",
        "ankle": "{left}ankle|{left}foot", "foot": "{left}toe", "spine1": "chest|lowerback|torso",
        "spine2": "chest2", "spine3": "chest3", "neck": "neck", "head": "head", "collar": "{left}collar",
        "shoulder": "{left}shoulder|{left}uparm", "elbow": "{left}elbow|{left}lowarm",
        "wrist": "{left}wrist|{left}hand",
    },
    "MHR": {
        "pelvis": "root", "hip": "{l}upleg", "knee": "{l}lowleg", "ankle": "{l}foot", "foot": "{l}ball",
        "spine1": "cspine0", "spine2": "cspine1", "spine3": "cspine3", "neck": "cneck", "head": "chead",
        "collar": "{l}clavicle", "shoulder": "{l}uparm", "elbow": "{l}lowarm", "wrist": "{l}wrist",
        "tip": "{l}middle1",
    },
    "SOMA": {
        "pelvis": "hips", "hip": "{left}leg", "knee": "{left}shin", "ankle": "{left}foot", "foot": "{left}toebase",
        "spine1": "spine1", "spine2": "spine2", "spine3": "chest", "neck": "neck1", "head": "head",
        "collar": "{left}shoulder", "shoulder": "{left}arm", "elbow": "{left}forearm", "wrist": "{left}hand",
        "tip": "{left}handmiddle1|{left}handmiddleend",
    },
    "VRoid": {
        "pelvis": "jbipchips", "hip": "jbip{l}upperleg", "knee": "jbip{l}lowerleg", "ankle": "jbip{l}foot",
        "foot": "jbip{l}toebase", "spine1": "jbipcspine", "spine2": "jbipcchest", "spine3": "jbipcupperchest",
        "neck": "jbipcneck", "head": "jbipchead", "collar": "jbip{l}shoulder", "shoulder": "jbip{l}upperarm",
        "elbow": "jbip{l}lowerarm", "wrist": "jbip{l}hand", "tip": "jbip{l}middle1",
    },
    "MocapNET": {
        "pelvis": "hip", "hip": "{l}hip|{l}thigh", "knee": "{l}knee|{l}shin", "ankle": "{l}foot|{l}ankle",
        "foot": "{l}toe", "spine1": "abdomen", "spine3": "chest", "neck": "neck", "head": "head",
        "collar": "{l}collar", "shoulder": "{l}shoulder|{l}shldr", "elbow": "{l}elbow|{l}forearm",
        "wrist": "{l}hand|{l}wrist", "tip": "{l}mid1|{l}finger31",
    },
    "Rokoko": {
        "pelvis": "hips|hip", "hip": "{left}thigh|{left}upleg", "knee": "{left}shin|{left}leg",
        "ankle": "{left}foot", "foot": "{left}toe|{left}toebase", "spine1": "spine1|spine", "spine2": "spine2|chest",
        "spine3": "spine4|spine3", "neck": "neck", "head": "head", "collar": "{left}shoulder",
        "shoulder": "{left}arm|{left}upperarm", "elbow": "{left}forearm|{left}lowerarm", "wrist": "{left}hand",
        "tip": "{left}handmiddle1|{left}middleproximal|{left}finger3proximal",
    },
}  # fmt: skip
"""Common rigs: SMPL's body part -> the bone's name without separators, lower case; `{l}` and `{left}` stand for the
side, `|` separates alternatives. A `tip` gives the direction of the hand and is not posed."""
NEEDED = (
    "pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
"""A rig needs these to be posed, and one bone of spine, neck and head."""
UNMATCHED = "has bones that cannot be matched to SMPL's joints"
NAME_BONES = "name them as one of the rigs that the manual lists under Motion"
"""Error and remedy for a file where `map_bones` fails."""
_TRUNK = ("spine1", "spine2", "spine3", "neck", "head")
_LIMBS = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist", "wrist": "hand"}
"""Parts whose direction towards the next part gives their rotation."""
_SHORTEST = 1e-6
_LISTED = 36
"""Characters of names in a list."""


@dataclasses.dataclass(frozen=True)
class BoneMap:
    """Bones of a rig by SMPL's joints."""

    rig: str
    """A key of `RIGS`."""
    joints: dict[str, str]
    """SMPL's joint -> the bone's name; all of `NEEDED`, and other joints that the rig has."""
    tips: dict[str, str]
    """left_wrist and right_wrist -> a bone to which the hand points, where there is one."""


def map_bones(names: Iterable[str]) -> BoneMap:
    """The bones as the rig whose names fit best, with any prefix that they share.

    Raises ValueError where no rig matches; it names the missing joints and some of the bones.
    """
    bones = list(names)
    plain = {}
    for bone in bones:
        plain.setdefault(_plain(bone), bone)
    found = [_match(rig, prefix, plain) for rig in RIGS for prefix in _prefixes(rig, plain)]
    best = max(found, key=lambda m: (len(m.joints), len(m.tips)), default=BoneMap("SMPL", {}, {}))
    missing = _missing_joints(best.joints)
    if missing:
        raise ValueError(
            f"none is known to be {_listed(missing)}; nearest rig: {best.rig}; the bones are {_listed(bones)}"
        )
    return best


def expected_names(part: str, rig: str, side: str) -> list[str]:
    """Normalized names of a body part (`hip`, `tip`, ...) in a rig, on the side `left` or `right`."""
    pattern = RIGS[rig].get(part, "")
    return [name.format(l=side[0], left=side) for name in pattern.split("|") if name]


def facing(heads: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Rotation [3, 3] whose columns are left, up and front of a person in the rig's axes.

    `heads` are joint positions by SMPL's names. Rest poses stand upright, so up is snapped to the nearest axis unless
    it is far off, and left where it nearly is an axis. Raises ValueError where the joints lie on a line, or the trunk
    does not continue the legs: bones that all lie along one axis at rest are not a pose.
    """
    if not is_standing(heads):
        raise ValueError("the shoulders are not above the hips, and these above the ankles: this is not a rest pose")
    hips = (heads["left_hip"] + heads["right_hip"]) / 2
    shoulders = (heads["left_shoulder"] + heads["right_shoulder"]) / 2
    ankles = (heads["left_ankle"] + heads["right_ankle"]) / 2
    left = heads["left_hip"] - heads["right_hip"] + heads["left_shoulder"] - heads["right_shoulder"]
    up = (shoulders - hips) + (hips - ankles)
    height = np.linalg.norm(up)
    up = _towards_axis(up / max(float(height), 1e-30), 30.0)
    left = left - up * (left @ up)
    width = np.linalg.norm(left)
    if height < _SHORTEST or width < 1e-3 * height:
        raise ValueError("hips, shoulders and ankles lie on a line: this is not a rest pose of a person")
    left = _towards_axis(left / width, 5.0)
    left = left - up * (left @ up)
    left /= np.linalg.norm(left)
    return np.stack([left, up, np.cross(left, up)], -1)


def rig_from_smpl(
    heads: Mapping[str, NDArray], tips: Mapping[str, NDArray], rest: NDArray = REST_JOINTS
) -> NDArray[np.float64]:
    """Rotations [24, 3, 3] of each body part from SMPL's rest pose to the rig's.

    `heads` are the rig's joints at rest by SMPL's names, `tips` where its hands point, both y up and facing +z; `rest`
    [24, 3] are the body's joints. Limbs are turned the shortest way, each going on from its parent, so an arm that
    hangs carries its hand along. Feet stand flat at both rests: they turn about the vertical alone, whatever the shoes.
    The trunk counts as upright at both: spines differ in shape and say nothing of the pose.
    """
    turned = np.tile(np.eye(3), (len(JOINT_NAMES), 1, 1))
    for joint, name in enumerate(JOINT_NAMES):
        side, _, part = name.partition("_")
        parent = PARENTS[joint]
        if part == "ankle":
            turned[joint] = _heading(heads, side, rest)
        elif part and part != "collar":
            turned[joint] = turned[parent]
        target = f"{side}_{_LIMBS[part]}" if part in _LIMBS else ""
        end = heads.get(target, tips.get(name)) if target else None
        if end is None or name not in heads:
            continue
        here = end - heads[name]
        there = turned[joint] @ (rest[JOINT_NAMES.index(target)] - rest[joint])
        if np.linalg.norm(here) > _SHORTEST:
            turned[joint] = between(there, here) @ turned[joint]
    return turned


def retarget(
    bones: BoneMap, rest: Mapping[str, NDArray], turned: Mapping[str, NDArray]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Joint rotations of SMPL [F, 24, 3, 3], y up as the rest pose stands, and the rotation [3, 3] from the rig's axes.

    Each body part gets its bone's rotation in the world; the difference between the rig's rest pose and SMPL's T is
    added (`rig_from_smpl`). `rest` are places of bones at rest [3] and `turned` their rotations in the world from there
    [F, 3, 3], by name. A joint without a bone follows its parent. Raises ValueError where `rest` is not a person.
    """
    heads = {joint: rest[bone] for joint, bone in bones.joints.items()}
    tips = {joint: rest[bone] for joint, bone in bones.tips.items()}
    from_file = facing(heads).T
    at_rest = rig_from_smpl(
        {joint: from_file @ place for joint, place in heads.items()},
        {joint: from_file @ place for joint, place in tips.items()},
    )
    frames = len(turned[bones.joints["pelvis"]])
    world = np.tile(np.eye(3), (frames, len(JOINT_NAMES), 1, 1))
    for joint, name in enumerate(JOINT_NAMES):
        if name in bones.joints:
            world[:, joint] = from_file @ turned[bones.joints[name]] @ from_file.T @ at_rest[joint]
        elif joint:
            world[:, joint] = world[:, PARENTS[joint]]
    return unchain(world), from_file


def _missing_joints(joints: Mapping[str, str]) -> list[str]:
    missing = [joint for joint in NEEDED if joint not in joints]
    return missing if any(joint in joints for joint in _TRUNK) else [*missing, "spine1"]


def _plain(bone: str) -> str:
    return re.sub(r"[^a-z0-9]", "", bone.rsplit(":", 1)[-1].lower())


def _part(joint: str) -> tuple[str, str]:
    side, _, part = joint.partition("_")
    return (part, side) if part else (joint, "left")


def _prefixes(rig: str, plain: dict[str, str]) -> list[str]:
    """Prefixes of the rig's names in the bones, such as a character's name, the most common first."""
    expected = {name for joint in NEEDED for part, side in [_part(joint)] for name in expected_names(part, rig, side)}
    counts = Counter(bone.removesuffix(name) for bone in plain for name in expected if bone.endswith(name))
    return [prefix for prefix, _ in counts.most_common(3)]


def _match(rig: str, prefix: str, plain: dict[str, str]) -> BoneMap:
    joints, tips = {}, {}
    for joint in JOINT_NAMES:
        part, side = _part(joint)
        for name in expected_names(part, rig, side):
            if prefix + name in plain:
                joints[joint] = plain[prefix + name]
                break
    for side in ("left", "right"):
        for name in expected_names("tip", rig, side):
            if prefix + name in plain:
                tips[f"{side}_wrist"] = plain[prefix + name]
                break
    return BoneMap(rig, joints, tips)


def _listed(names: list[str]) -> str:
    """Whole names, as many as a sentence has room for, and how many are left out."""
    shown = names[:1]
    for name in names[1:]:
        if sum(map(len, shown)) + len(name) > _LISTED:
            break
        shown.append(name)
    text = ", ".join(f"{name!r:.40}" for name in shown)
    return text if len(shown) == len(names) else f"{text} and {len(names) - len(shown)} more"


def _towards_axis(direction: NDArray, degrees: float) -> NDArray[np.float64]:
    """The nearest axis, where it is within `degrees` of a unit vector [3]; else the vector."""
    axis = np.zeros(3)
    largest = int(np.abs(direction).argmax())
    axis[largest] = np.sign(direction[largest])
    return axis if axis @ direction > np.cos(np.radians(degrees)) else direction


def _heading(heads: Mapping[str, NDArray], side: str, rest: NDArray) -> NDArray[np.float64]:
    toe = heads.get(f"{side}_foot")
    if toe is None:
        return np.eye(3)
    here = toe - heads[f"{side}_ankle"]
    there = rest[JOINT_NAMES.index(f"{side}_foot")] - rest[JOINT_NAMES.index(f"{side}_ankle")]
    if np.hypot(here[0], here[2]) < 0.2 * np.linalg.norm(here):  # the foot hangs: its heading is not to be seen
        return np.eye(3)
    return about_axis(1, np.arctan2(here[0], here[2]) - np.arctan2(there[0], there[2]))
