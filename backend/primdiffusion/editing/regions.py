"""Regions of a human: sets of primitives, selected by part names or painted on the body.

A part consists of the primitives that mainly follow certain joints, cut at the borders of clothes and hair rather than
at the joints. The cuts were chosen from the colours of the default checkpoint's training set: shirt, face and hair;
docs/design/diffusion_edits.md shows them.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.files.arrays import read_numbers
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.requests import PARTS, SIDED_PARTS, WHOLE_PARTS
from primdiffusion.geometry.surface import surface_points
from primdiffusion.primitives.anchors import Anchors, anchor_skin_weights, attach, default_anchors, default_texels
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import GRID, K, S

HEM, SEAT = -0.028, -0.125
"""Heights above the rest body's pelvis, metres: the hem of most shirts, and the border of hips and thighs."""
COLLAR_HEIGHT, COLLAR_SLOPE = 0.007, -0.42
"""The plane y = height + slope * z, metres from the neck's joint: shirt below, skin above."""
NAPE_DEPTH, HAIRLINE_SLOPE = -0.052, 1.4
"""The plane z = depth + slope * y, metres from the head's joint: hair lies behind it."""
MOST_WEIGHTS = 1_000_000
"""Vertices with painted weights; bodies have about ten thousand."""
CUFF = 0.02
"""End of long sleeves, metres from the wrist's joint towards the hand."""

_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar")
_SIDED = {
    "upper_arms": ("shoulder",),
    "forearms": ("elbow",),
    "hands": ("wrist", "hand"),
    "thighs": ("hip",),
    "shins": ("knee",),
    "feet": ("ankle", "foot"),
}
"""Paired parts, and the joints that move them."""
_ONE_OF = {
    "upper_arms": "upper_arm",
    "forearms": "forearm",
    "hands": "hand",
    "thighs": "thigh",
    "shins": "shin",
    "feet": "foot",
}
_UNIONS = {
    "head": ("face", "hair", "neck"),
    "arms": ("upper_arms", "forearms"),
    "legs": ("thighs", "shins"),
    "top": ("torso", "neck", "upper_arms", "forearms"),  # the neck has the collar
    "bottom": ("hips", "thighs", "shins"),
    "shoes": ("feet",),
    "clothes": ("top", "bottom", "shoes"),
    "skin": ("face", "neck", "hands"),
}
"""Names for several parts together."""
_CHOICES = f"{', '.join(WHOLE_PARTS)}, and left_ or right_ with {', '.join(_ONE_OF.values())}"
DISJOINT = ("face", "hair", "neck", "torso", "hips", *SIDED_PARTS)
"""A partition of all primitives."""


def read_weights(path: str | Path) -> Float[Tensor, "v"]:
    """Read painted weights. Raises FileNotFoundError, and ValueError for a file without usable weights."""
    weights = read_numbers(path, ("weights",), most_values=MOST_WEIGHTS)["weights"]
    if weights.ndim != 1:
        raise ValueError(f"weights in {path} are {weights.dtype} {weights.shape}: give one number for each vertex")
    return torch.from_numpy(weights.astype(np.float32))


def region_of(names: Sequence[str], body_setup: BodySetup | None = None) -> Bool[Tensor, "k"]:
    """Return the union of the named parts on a body (None: the default body).

        >>> region = pd.region_of(["top", "shoes"])
        >>> region.shape  # a mask of boxes
        torch.Size([1024])

    Raises ValueError for no names or an unknown one.
    """
    if not names:
        raise ValueError(f"the region is empty: name one or more of {_CHOICES}")
    parts = parts_of(body_setup)
    for name in names:
        if name not in parts:
            raise ValueError(f"unknown part of the body {name!r:.40}: choose from {_CHOICES}")
    return torch.stack([parts[name] for name in names]).any(0)


PAINTED = 0.5
"""Mean weight from which a primitive is painted."""


def region_from_weights(weights: Float[Tensor, "v"], body_setup: BodySetup | None = None) -> Bool[Tensor, "k"]:
    """Return the primitives whose mean painted weight is at least PAINTED.

    `weights` holds a number from 0 to 1 for each vertex of the body, in its order (a vertex group in
    Blender). The mean is over the primitive's 8 x 8 texels; on a body other than the default one, at its anchor.

    Raises ValueError for a wrong number of vertices, values that are not finite, and a region without primitives.
    """
    body = default_body() if body_setup is None else body_setup.body
    if tuple(weights.shape) != (len(body.template),):
        given, wanted = tuple(weights.shape), len(body.template)
        raise ValueError(f"the painted weights have shape {given}: give one number for each of the {wanted} vertices")
    if not torch.isfinite(weights).all():
        raise ValueError("the painted weights contain NaN or infinite values: paint them again")
    covered = _covered(weights.float().cpu(), body_setup)
    region = covered >= PAINTED - 1e-6  # weights painted at exactly this average to slightly less, by rounding
    if not region.any():
        raise ValueError(
            f"the painted region covers no primitive (mean weight at most {float(covered.max()):.2f}, {PAINTED} is "
            "needed): paint a larger area, or with more strength"
        )
    return region


def check_region(region: Tensor) -> Bool[Tensor, "k"]:
    """Return the region on the CPU. Raises ValueError unless it is a non-empty bool mask of K."""
    if tuple(region.shape) != (K,) or region.dtype != torch.bool:
        given = f"{region.dtype} {tuple(region.shape)}".removeprefix("torch.")
        raise ValueError(f"the region is {given}: give a mask bool ({K},), a value for each primitive")
    if not region.any():
        raise ValueError("the region is empty: name a part of the body, or paint one")
    return region.cpu()


def name_region(region: Bool[Tensor, "k"], body_setup: BodySetup | None = None) -> list[str] | str:
    """Serialise a region: names of its parts, or for painted ones 1024 bits in hexadecimal, primitive 0 first."""
    parts = parts_of(body_setup)
    for name in PARTS:
        if torch.equal(parts[name], region):
            return [name]
    inside = [name for name in DISJOINT if bool(region[parts[name]].all())]
    if inside and torch.equal(region_of(inside, body_setup), region):
        return inside
    return int("".join("1" if chosen else "0" for chosen in region.tolist()), 2).to_bytes(K // 8, "big").hex()


def parts_of(body_setup: BodySetup | None = None) -> Mapping[str, Bool[Tensor, "k"]]:
    """Masks of all PARTS on a body (None: the default body)."""
    return _default_parts() if body_setup is None else _parts(body_setup.body, body_setup.anchors)


@functools.lru_cache(maxsize=1)
def _default_parts() -> Mapping[str, Bool[Tensor, "k"]]:
    return _parts(default_body(), default_anchors())


def _covered(weights: Float[Tensor, "v"], body_setup: BodySetup | None) -> Float[Tensor, "k"]:
    """Mean weight of each primitive."""
    if body_setup is not None:
        face, barycentric = body_setup.anchors.face, body_setup.anchors.barycentric
        return surface_points(weights[:, None], body_setup.body.faces, face, barycentric)[:, 0]
    face, barycentric = default_texels()
    texels = surface_points(weights[:, None], default_body().faces, face.flatten(), barycentric.flatten(0, 1))
    return texels.reshape(GRID, S, GRID, S).mean((1, 3)).flatten()


def _parts(body: BodyModel, anchors: Anchors) -> Mapping[str, Bool[Tensor, "k"]]:
    rest = attach(anchors, body.template, body.faces).position
    joints = body.shape(torch.zeros_like(body.shape_basis[0, 0])).joints

    def from_joint(name: str) -> tuple[Tensor, Tensor]:
        """Offsets of the anchors from a joint, up and forward, metres."""
        up, forward = (rest - joints[JOINT_NAMES.index(name)])[:, 1:].unbind(-1)
        return up, forward

    (up, _), (up_neck, forward_neck), (up_head, forward_head) = map(from_joint, ("pelvis", "neck", "head"))
    joint = anchor_skin_weights(anchors, body).argmax(-1)
    by_joint = {name: joint == i for i, name in enumerate(JOINT_NAMES)}
    neck_or_head = by_joint["neck"] | by_joint["head"]
    collar = by_joint["neck"] & (up_neck < COLLAR_HEIGHT + COLLAR_SLOPE * forward_neck)
    hair = neck_or_head & (forward_head < NAPE_DEPTH + HAIRLINE_SLOPE * up_head)
    trunk = torch.stack([by_joint[name] for name in _TRUNK]).any(0)
    to_the_knees = trunk | by_joint["left_hip"] | by_joint["right_hip"]
    above_hem, above_seat = to_the_knees & (up > HEM), to_the_knees & (up > SEAT)
    parts = {
        "face": by_joint["head"] & ~hair,
        "hair": hair,
        "neck": by_joint["neck"] & ~hair & ~collar,
        "torso": above_hem | collar,
        "hips": above_seat & ~above_hem,
    }
    for side, outward in (("left", 1.0), ("right", -1.0)):
        for part, names in _SIDED.items():
            moved = torch.stack([by_joint[f"{side}_{name}"] for name in names]).any(0)
            parts[f"{side}_{_ONE_OF[part]}"] = moved & ~above_seat
        beyond_wrist = outward * (rest - joints[JOINT_NAMES.index(f"{side}_wrist")])[:, 0]
        cuff = parts[f"{side}_hand"] & (beyond_wrist < CUFF)
        parts[f"{side}_forearm"] |= cuff
        parts[f"{side}_hand"] &= ~cuff
    for part, one in _ONE_OF.items():
        parts[part] = parts[f"left_{one}"] | parts[f"right_{one}"]
    for name, members in _UNIONS.items():
        parts[name] = torch.stack([parts[member] for member in members]).any(0)
    return parts
