"""Quality of a human's fit to its pictures: one number, and what to do about a bad one.

The human is drawn in its posture, with the colours that explain the pictures best. What counts is how far outlines and
colours differ, whether limbs lie within the mask and hands are where they were put, and whether knees and elbows bend
as they can.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.rotation import matrix_to_axis_angle
from primdiffusion.primitives.anchors import anchor_skin_weights, default_anchors
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.reconstruction.posture_fit import COARSE, Posture, each
from primdiffusion.reconstruction.posture_masks import grown, unexplained
from primdiffusion.reconstruction.prior_fit import PriorFit
from primdiffusion.render.image import PosedView
from primdiffusion.render.march import march

LEAST_PERCENT = 85
"""A fit below has probably failed; one of `LIMITS` is reached."""
LIMITS: Mapping[str, float] = {
    "outline": 0.03,
    "colour": 0.09,
    "unexplained": 0.03,
    "left_out": 0.1,
    "outside": 0.28,
    "foot": 0.2,
    "hand": 0.2,
    "hands": 0.04,
    "hidden": 0.75,
    "head": 0.06,
    "skin": 0.77,
    "joint": 1.0,
}
"""Values that fits of whole people in good masks stay below (`benchmarks/plain_pictures.py spoiled`)."""
COLOUR_STEPS = 3
"""Gauss-Newton steps to the person coefficients that draw the colours."""
EDGE_PX = 1
"""Difference of outlines that does not count, pixels of the small pictures that are compared."""
PATTERN_PX, HEAD_PX = 11, 3
"""Sides of the squares over which colours of the figure and of its head are compared, in the same pixels: patterns and
faces are not drawn exactly."""
LARGEST_DIFFERENCE, HEAD_SHARE = 0.1, 0.25
"""Largest difference of encoded colour that counts where pictures of a person are compared, and weight of the head."""
SKIN_DIFFERENCE = 0.1
"""Difference of encoded colour from that of a hand, up to which a pixel of the head is skin."""
FRONT = 0.5
"""Cosine of the angle to the camera from which a body shows face and hands."""
KNEE_DEGREES, ELBOW_DEGREES = 30.0, 80.0
"""Largest bends of a knee sideways or forward, and of an elbow backward: the twist of an upper arm is not seen."""
LIMBS: Mapping[str, tuple[str, ...]] = {
    f"{side} {limb}": tuple(f"{side}_{joint}" for joint in joints)
    for side in ("left", "right")
    for limb, joints in {
        "hand": ("wrist", "hand"),
        "forearm": ("elbow", "wrist", "hand"),
        "lower leg": ("knee", "ankle", "foot"),
        "foot": ("ankle", "foot"),
    }.items()
} | {"head": ("head",)}
"""Ends of limbs and the head, by the joints that move them."""


class FitQuality(NamedTuple):
    """Errors of a human in one picture; each value is 0 at best, and `LIMITS` has the largest of good fits."""

    outline: float
    """1 - intersection over union of the outlines, but for their edges."""
    colour: float
    """Difference of encoded colour, means over small squares, that nine tenths of the pixels do not exceed."""
    unexplained: float
    """Share of the mask that is not a part of the human, even with wide clothes."""
    left_out: float
    """Share of the mask that was left out of the fit."""
    outside: float
    """Share of a forearm or a lower leg outside of the mask, the largest."""
    foot: float
    """Share of a foot outside of the mask, the larger one."""
    hand: float
    """Mean difference of encoded colour at a hand, the larger one."""
    hands: float
    """The picture's difference of colour between the hands, but for brightness: a palm is lighter than a back. 0 where
    the body does not face the camera."""
    hidden: float
    """Share of one hand that the body hides, by what is seen of the other; likewise."""
    head: float
    """The same difference as at a hand, of means over small squares, at the head."""
    skin: float
    """Share of the head that has not the colour of a hand; likewise."""
    joint: float
    """Angle of a knee or an elbow, by how far it can bend in that direction, the largest."""
    limb: str
    """The limb outside of the mask."""

    @property
    def worst(self) -> str:
        """The value that is largest by its limit."""
        return max(LIMITS, key=lambda name: getattr(self, name) / LIMITS[name])

    @property
    def percent(self) -> int:
        """100 of a picture that is explained in full, LEAST_PERCENT where one value reaches its limit."""
        share = getattr(self, self.worst) / LIMITS[self.worst]
        return max(0, math.floor(100 - (100 - LEAST_PERCENT) * share))

    def content(self) -> dict[str, Any]:
        """The values, as posture.json holds them."""
        values = {name: round(getattr(self, name), 4) for name in LIMITS}
        return {"percent": self.percent, "worst": self.worst, **values}

    def warnings(self) -> list[str]:
        """Say what to do about a fit below LEAST_PERCENT, and about what was left out, in a sentence each."""
        warnings = []
        if self.left_out:
            warnings.append(
                f"{100 * self.left_out:.0f} % of the mask belongs to no body (a bag, a chair?) and was left out: if it "
                "is a limb, pose a human over the picture and fit again"
            )
        if self.percent < LEAST_PERCENT:
            what = {
                "outline": "the outlines of the body and of the mask differ",
                "colour": "colours within the mask are not those of a person seen from the front",
                "unexplained": f"{100 * self.unexplained:.0f} % of the mask belongs to no body",
                "left_out": "too much of the mask was left out",
                "outside": f"the {self.limb} lies outside of the mask",
                "foot": "a foot lies outside of the mask: it is hidden or cut off",
                **dict.fromkeys(
                    ("hand", "hands", "hidden"),
                    "a hand is not where the body has it: it is hidden, cut off, or seen from behind",
                ),
                **dict.fromkeys(("head", "skin"), "the head is not that of a person seen from the front"),
                "joint": "a knee or an elbow bends as it cannot",
            }[self.worst]
            warnings.append(
                f"the fit is {self.percent} %: {what}; pose a human over the picture by hand, or mask what is not the "
                "person"
            )
        return warnings


def quality_of(
    components: PriorFit, posture: Posture, targets: Sequence[PosedView], left_out: float = 0.0
) -> FitQuality:
    """Rate a posture by its pictures: of several, by the one that it explains worst.

    `targets` are small pictures by the posture's own cameras and boxes; `left_out` a share of their masks before.
    """
    people = components.everyone()
    for _ in range(COLOUR_STEPS):
        people = components.gauss_newton_step(people, targets)
    payload = components.payload(components.coefficients(people))
    found = []
    for pose, target, facing in zip(each(posture.pose), targets, posture.facing.tolist(), strict=True):
        one = _quality(payload, pose, target, left_out)
        found.append(one if facing > FRONT else one._replace(hands=0.0, hidden=0.0, skin=0.0))
    return min(found, key=lambda one: one.percent)


@torch.no_grad()
def colour_error(payload: Payload, target: PosedView) -> float:
    """Mean difference of encoded colour over the figure and over its head, of means over small squares.

    A limb that is elsewhere counts as LARGEST_DIFFERENCE at most.
    """
    _, difference, inner = _compared(payload, target)
    differs = _mean_around(difference, inner, HEAD_PX).abs().mean(-1)
    head = _limbs_drawn(payload, target)["head"] * inner
    of_head = float((head * differs).sum() / head.sum().clamp_min(1e-6))
    return of_head * HEAD_SHARE + float(differs[inner].clamp_max(LARGEST_DIFFERENCE).mean()) if inner.any() else 1.0


def _compared(
    payload: Payload, target: PosedView
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """Opacity of the human drawn, its difference of encoded colour from the picture, and where both are opaque."""
    seen, opacity = march(Primitives.place(target.frames, payload), target.camera, COARSE), target.rgba[..., 3]
    difference = encode_srgb(seen.rgb.clamp(1e-4, 1)) - encode_srgb(target.rgba[..., :3].clamp(1e-4, 1))
    return seen.alpha, difference, (opacity > 0.9) & (seen.alpha > 0.9)


@torch.no_grad()
def _quality(payload: Payload, pose: BodyPose, target: PosedView, left_out: float) -> FitQuality:
    (alpha, difference, inner), opacity = _compared(payload, target), target.rgba[..., 3]
    mask, drawn = opacity > 0.5, alpha > 0.5
    wrong = (mask & ~grown(drawn, EDGE_PX)) | (drawn & ~grown(mask, EDGE_PX))
    differs = difference.abs().mean(-1)
    inside = _mean_around(difference, inner, PATTERN_PX).abs().mean(-1)[inner]
    of_head, outside, colour = _mean_around(difference, inner, HEAD_PX).abs().mean(-1), {}, {"head": 0.0}
    drawn_limbs = _limbs_drawn(payload, target)
    for limb, share in drawn_limbs.items():
        within = share * mask
        outside[limb] = 1 - float(within.sum() / share.sum().clamp_min(1e-6)) if share.sum() else 0.0
        weights, values = (share * inner, of_head) if limb == "head" else (within, differs)
        colour[limb] = float((weights * values).sum() / weights.sum().clamp_min(1e-6))
    hand, foot = (
        max(values[f"{side} {part}"] for side in ("left", "right"))
        for values, part in ((colour, "hand"), (outside, "foot"))
    )
    outside = {limb: share for limb, share in outside.items() if limb.endswith(("forearm", "lower leg"))}
    limb = max(outside, key=lambda name: outside[name])
    hands, hidden, skin = _hands_and_skin(drawn_limbs, target)
    return FitQuality(
        outline=float(wrong.sum() / (mask | drawn).sum()),
        colour=float(inside.quantile(0.9)) if len(inside) else 1.0,
        unexplained=float(unexplained(alpha, opacity).sum() / mask.sum()),
        left_out=left_out,
        outside=outside[limb],
        foot=foot,
        hand=hand,
        hands=hands,
        hidden=hidden,
        head=colour["head"],
        skin=skin,
        joint=_strain(pose),
        limb=limb,
    )


def _hands_and_skin(limbs: Mapping[str, Float[Tensor, "H W"]], target: PosedView) -> tuple[float, float, float]:
    """`FitQuality.hands`, `hidden` and `skin`, of the picture's colours where these limbs are drawn."""
    opacity = target.rgba[..., 3]
    picture = encode_srgb((target.rgba[..., :3] / opacity[..., None].clamp_min(0.1)).clamp(1e-4, 1))
    drawn = [limbs[f"{side} hand"] for side in ("left", "right")]
    hands = [_mean(picture, share * (opacity > 0.5)) for share in drawn]
    skin = [((picture - own).abs().mean(-1, keepdim=True) < SKIN_DIFFERENCE).float() for own in hands]
    of_skin = max(float(_mean(one, limbs["head"] * (opacity > 0.5))) for one in skin)
    seen, hue = [float(share.sum()) for share in drawn], [own / own.sum().clamp_min(1e-3) for own in hands]
    return float((hue[0] - hue[1]).abs().mean()), 1 - min(seen) / max(*seen, 1e-6), 1 - of_skin


def _mean(values: Float[Tensor, "H W c"], weights: Float[Tensor, "H W"]) -> Float[Tensor, "c"]:
    """Mean by weights; 0 where they are."""
    return (values * weights[..., None]).sum((0, 1)) / weights.sum().clamp_min(1e-6)


def _mean_around(values: Float[Tensor, "H W 3"], inner: Bool[Tensor, "H W"], side: int) -> Float[Tensor, "H W 3"]:
    """Means over the pixels of the figure in squares, in which stripes and checks are one colour."""
    weights = torch.cat([values * inner[..., None], inner[..., None].float()], -1).movedim(-1, 0)[None]
    sums = torch.nn.functional.avg_pool2d(weights, side, stride=1, padding=side // 2)[0]
    return (sums[:3] / sums[3:].clamp_min(1e-6)).movedim(0, -1)


def _limbs_drawn(payload: Payload, target: PosedView) -> dict[str, Float[Tensor, "H W"]]:
    """Contribution of the boxes of each limb to the pixels."""
    limbs, drawn = list(LIMBS), []
    for first in range(0, len(limbs), 3):
        marked = torch.zeros_like(payload.rgb)
        for channel, limb in enumerate(limbs[first : first + 3]):
            joints = [JOINT_NAMES.index(name) for name in LIMBS[limb]]
            marked[torch.isin(_joint_of_boxes(), torch.tensor(joints)), channel] = 1
        boxes = Primitives.place(target.frames, dataclasses.replace(payload, rgb=marked))
        drawn += march(boxes, target.camera, COARSE).rgb.unbind(-1)
    return dict(zip(limbs, drawn, strict=True))


@functools.cache
def _joint_of_boxes() -> Tensor:
    return anchor_skin_weights(default_anchors(), default_body()).argmax(-1)


def _strain(pose: BodyPose) -> float:
    turn, strain = matrix_to_axis_angle(pose.joint_rotation), [0.0]
    for side, backward in (("left", 1.0), ("right", -1.0)):
        knee, elbow = (turn[JOINT_NAMES.index(f"{side}_{name}")] for name in ("knee", "elbow"))
        strain.append(max(-float(knee[0]), float(knee[1:].norm())) / math.radians(KNEE_DEGREES))
        strain.append(backward * float(elbow[1]) / math.radians(ELBOW_DEGREES))
    return max(strain)
