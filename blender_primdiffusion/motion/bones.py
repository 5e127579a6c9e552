"""Bones of other rigs as SMPL's joints, by their names."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Iterable, Mapping

from ..formats.joints import JOINT_NAMES

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
}  # fmt: skip
"""Rigs people have: SMPL's part of the body -> the bone's name without separators, lower case; `{l}` and `{left}` stand
for the side, `|` between alternatives. A `tip` shows where the hand points and is not turned itself."""

NEEDED = (
    "pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
"""Without these a rig cannot be posed; of the spine, the neck and the head one bone is enough."""
BY_HAND = "chosen by hand"
_TRUNK = ("spine1", "spine2", "spine3", "neck", "head")


class UnknownBonesError(ValueError):
    """Bones whose names are those of no rig that is known; one sentence that names what lacks."""


@dataclasses.dataclass(frozen=True)
class BoneMap:
    """Which bone of a rig is which joint."""

    rig: str
    """A key of `RIGS`, or `BY_HAND`."""
    joints: dict[str, str]
    """SMPL's joint -> the bone's name; all of `NEEDED`, and those of the others that are there."""
    tips: dict[str, str]
    """left_wrist and right_wrist -> a bone towards which the hand points, where there is one."""


def map_bones(names: Iterable[str]) -> BoneMap:
    """The rig whose names fit best, with any prefix that its bones share.

    Raises UnknownBonesError where no rig has all that is needed; it names the joints that lack and some of the bones.
    """
    bones = list(names)
    plain = {}
    for bone in bones:
        plain.setdefault(_plain(bone), bone)
    found = [_match(rig, prefix, plain) for rig in RIGS for prefix in _prefixes(rig, plain)]
    best = max(found, key=lambda m: (len(m.joints), len(m.tips)), default=BoneMap("SMPL", {}, {}))
    lacking = _lacking(best.joints)
    if lacking:
        raise UnknownBonesError(
            f"no bone is known to be {_listed(lacking)} (nearest rig: {best.rig}); the bones are {_listed(bones)}: "
            "name them as in SMPL, Mixamo, Unreal, Rigify or RenderPeople"
        )
    return best


def chosen_bones(names: Iterable[str], joints: Mapping[str, str]) -> BoneMap:
    """The map that somebody chose, SMPL's joint -> bone; empty bones count as not chosen.

    Raises UnknownBonesError for a joint that SMPL does not have, a bone that is not among `names`, and where one that
    is needed is not chosen.
    """
    bones = list(names)
    chosen = {joint: bone for joint, bone in joints.items() if bone}
    for joint, bone in chosen.items():
        if joint not in JOINT_NAMES:
            raise UnknownBonesError(
                f"the bone map names {joint!r}, which is none of SMPL's joints: correct or remove it"
            )
        if bone not in bones:
            raise UnknownBonesError(
                f"the bone map wants {bone!r} for {joint}, which the file does not have; its bones are "
                f"{_listed(bones)}: choose one of them"
            )
    lacking = _lacking(chosen)
    if lacking:
        raise UnknownBonesError(f"the bone map has no bone for {_listed(lacking)}: choose one for each")
    return BoneMap(BY_HAND, chosen, {})


def _lacking(joints: Mapping[str, str]) -> list[str]:
    lacking = [joint for joint in NEEDED if joint not in joints]
    return lacking if any(joint in joints for joint in _TRUNK) else [*lacking, "spine1"]


def expected_names(part: str, rig: str, side: str) -> list[str]:
    """Plain names that a rig has for a part of the body (`hip`, `tip`, ...) on the side `left` or `right`."""
    pattern = RIGS[rig].get(part, "")
    return [name.format(l=side[0], left=side) for name in pattern.split("|") if name]


def _plain(bone: str) -> str:
    return re.sub(r"[^a-z0-9]", "", bone.rsplit(":", 1)[-1].lower())


def _part(joint: str) -> tuple[str, str]:
    side, _, part = joint.partition("_")
    return (part, side) if part else (joint, "left")


def _prefixes(rig: str, plain: dict[str, str]) -> list[str]:
    """What stands before the rig's names in many of the bones: a file's or a character's name. Commonest first."""
    wanted = {name for joint in NEEDED for part, side in [_part(joint)] for name in expected_names(part, rig, side)}
    counts = Counter(bone.removesuffix(name) for bone in plain for name in wanted if bone.endswith(name))
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
    shown = ", ".join(repr(name) for name in names[:8])
    return shown if len(names) <= 8 else f"{shown} and {len(names) - 8} more"
