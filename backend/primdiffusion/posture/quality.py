"""How far a fit of a posture can be trusted, as one number and what lowers it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import default_body
from primdiffusion.formats.joints import JOINT_NAMES, PARENTS
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.rotation import matrix_to_axis_angle
from primdiffusion.posture.fit import COARSE, JOINT_STD, Posture, each, encoded
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.render.inverse import TargetImage
from primdiffusion.render.march import march

LEAST = 0.85
"""Of fits that look right it is above."""
USUAL_RESIDUAL = 0.12
"""Root of the mean squared difference of encoded colours that a good fit leaves: patterns and faces."""
LIMB_COST, STRAIN_COST = 0.06, 0.02
"""What a limb outside of the mask, and a joint at its limit, take from the fit."""
STRAINED = 2.5
"""Standard deviations from the start at which a joint's limit is."""
FOREIGN = 0.03
"""Share of a mask, far from the body, from which it holds something else."""
_FAR = 0.05
"""From the body, as a share of the picture's side."""
_LIMBS = tuple(
    f"{side}_{end}" for side in ("left", "right") for end in ("elbow", "wrist", "hand", "knee", "ankle", "foot")
)
"""Joints at the ends of the bones that are looked for in the mask."""


@dataclasses.dataclass(frozen=True)
class Quality:
    """How well a posture explains pictures."""

    overlap: float
    """Intersection over union of the outlines."""
    residual: float
    """Root of the mean squared difference of encoded colours where both are."""
    outside: tuple[str, ...]
    """Joints at the ends of bones of which less than half lies in the mask."""
    strained: tuple[str, ...]
    """Joints turned as far as the fit lets them."""
    foreign: float
    """Share of the masks that is far from the body."""

    @property
    def fit(self) -> float:
        """0 to 1."""
        lost = LIMB_COST * len(self.outside) + STRAIN_COST * len(self.strained)
        return min(1.0, max(0.0, self.overlap - lost - max(0.0, self.residual - USUAL_RESIDUAL)))

    def doubts(self) -> list[str]:
        """A sentence on what to do, if the fit is below LEAST."""
        if self.fit >= LEAST:
            return []
        if self.outside:
            lost = " and ".join(name.replace("_", " ") for name in self.outside[:2])
            remedy = f"the {lost} did not find the mask; start from a pose that is nearer"
        elif self.foreign >= FOREIGN:
            held = f"{100 * self.foreign:.0f} % of the mask is not the person's body"
            remedy = f"{held}; take bags, seats and other objects out of the mask"
        else:
            remedy = "the pose was probably not found; start from one that is nearer"
        return [f"fit {100 * self.fit:.0f} %: {remedy}"]


@torch.no_grad()
def quality_of(
    posture: Posture, start: Posture, tightness: float, payload: Payload, targets: Sequence[TargetImage]
) -> Quality:
    """Compare the human's primitives on a posture with the pictures; `start` is where its fit began."""
    common = total = squares = pixels = far = masked = 0.0
    outside: dict[str, None] = {}
    poses = zip(targets, posture.frames(), each(posture.pose), strict=True)
    for target, frames, pose in poses:
        seen = march(Primitives.place(frames, payload), target.camera, COARSE)
        picture = torch.from_numpy(target.rgba)
        mask, both = picture[..., 3], torch.minimum(seen.alpha, picture[..., 3])
        common += float(both.sum())
        total += float(torch.maximum(seen.alpha, mask).sum())
        difference = encoded(seen.rgb, seen.alpha[..., None]) - encoded(picture[..., :3], mask[..., None])
        squares += float((both * difference[:3].square().mean(0)).sum())
        pixels += float(both.sum())
        far += float((mask * (1 - _grown(seen.alpha, round(_FAR * len(mask))))).sum())
        masked += float(mask.sum())
        places = default_body().shape(posture.betas).pose(pose).joints[:, :3, 3]
        outside |= dict.fromkeys(_outside(places, target.camera, _grown(mask, 1)))
    turn = matrix_to_axis_angle(start.pose.joint_rotation.mT @ posture.pose.joint_rotation).norm(dim=-1)
    over = (turn > STRAINED / tightness * JOINT_STD).any(0)
    strained = tuple(name for name, far_off in zip(JOINT_NAMES, over.tolist(), strict=True) if far_off)
    return Quality(common / total, (squares / max(pixels, 1.0)) ** 0.5, tuple(outside), strained, far / masked)


def _outside(places: Float[Tensor, "24 3"], camera: Camera, mask: Float[Tensor, "H W"]) -> list[str]:
    names = []
    for name in _LIMBS:
        end = JOINT_NAMES.index(name)
        bone = torch.lerp(places[PARENTS[end]], places[end], torch.linspace(0, 1, 9)[:, None])
        column, row = camera.project(bone)[0].floor().long().T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        if float(mask[row[inside], column[inside]].sum()) < 0.5 * len(bone):
            names.append(name)
    return names


def _grown(mask: Float[Tensor, "H W"], pixels: int) -> Float[Tensor, "H W"]:
    """Largest values within so many pixels."""
    return torch.nn.functional.max_pool2d(mask[None], 2 * pixels + 1, 1, pixels)[0]
