"""SMPL's 24 joints, and the mapping of the source rig's 104 bones to them."""

from __future__ import annotations

import numpy as np
from primdiffusion.formats.joints import JOINT_NAMES

_OTHER_SIDE = {"left": "right", "right": "left"}
MIRRORED_JOINT = np.array(
    [JOINT_NAMES.index("_".join(_OTHER_SIDE.get(word, word) for word in name.split("_"))) for name in JOINT_NAMES]
)
"""Joint j of a mirrored person is joint MIRRORED_JOINT[j] of the original."""

_TRUNK_BONES = {
    "root": "pelvis",
    "pelvis": "pelvis",
    "spine05": "pelvis",
    "spine04": "spine1",
    "spine03": "spine2",
    "spine02": "spine3",
    "spine01": "spine3",
    "head": "head",
    "eye": "head",
}
_LIMB_BONES = (  # the first match applies: the thumb's root moves with the wrist, the other fingers with the hand
    ("upperleg", "hip"),
    ("lowerleg", "knee"),
    ("foot", "ankle"),
    ("toe", "foot"),
    ("clavicle", "collar"),
    ("shoulder01", "collar"),
    ("upperarm", "shoulder"),
    ("lowerarm", "elbow"),
    ("wrist", "wrist"),
    ("metacarpal", "wrist"),
    ("finger1-1", "wrist"),
    ("finger", "hand"),
)
_TRUNK_HEADS = {
    "pelvis": "root",
    "spine1": "spine04",
    "spine2": "spine03",
    "spine3": "spine02",
    "neck": "neck01",
    "head": "head",
}
_LIMB_HEADS = {
    "hip": ["upperleg01"],
    "knee": ["lowerleg01"],
    "ankle": ["foot"],
    "foot": ["toe2-1", "toe3-1", "toe4-1"],
    "collar": ["clavicle"],
    "shoulder": ["upperarm01"],
    "elbow": ["lowerarm01"],
    "wrist": ["wrist"],
    "hand": ["finger2-1", "finger3-1", "finger4-1", "finger5-1"],
}


def joint_of_bone(bone: str) -> int:
    """The SMPL joint that corresponds to a bone of the source rig, such as "upperarm02.L"."""
    stem, _, side = bone.partition(".")
    if stem.startswith("neck"):
        return JOINT_NAMES.index("neck")
    if stem in _TRUNK_BONES:
        return JOINT_NAMES.index(_TRUNK_BONES[stem])
    for prefix, joint in _LIMB_BONES:
        if stem.startswith(prefix):
            return JOINT_NAMES.index({"L": "left_", "R": "right_"}[side] + joint)
    raise KeyError(f"The rig has a bone {bone!r} without an SMPL joint; add it to the tables of {__name__}.")


def joints_from_bone_heads(bones: list[str]) -> np.ndarray:
    """[24, len(bones)]: an SMPL joint is the mean of one or more bone heads."""
    weights = np.zeros((len(JOINT_NAMES), len(bones)))
    for j, name in enumerate(JOINT_NAMES):
        side, _, limb = name.partition("_")
        heads = [f"{head}.{side[0].upper()}" for head in _LIMB_HEADS[limb]] if limb else [_TRUNK_HEADS[name]]
        weights[j, [bones.index(head) for head in heads]] = 1 / len(heads)
    return weights
