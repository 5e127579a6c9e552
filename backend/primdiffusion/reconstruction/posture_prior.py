"""What is likely of a person in a photograph: it stands on a floor, and the camera is held by hand.

A picture alone cannot tell a leaning body before a level camera from an upright one before a tilted camera.
"""

from __future__ import annotations

import functools
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.body.model import BodyPose, ShapedBody, default_body, skin, world_from_joints, world_from_rest
from primdiffusion.formats.joints import JOINT_NAMES, PARENTS

TILT_STD = torch.tensor([math.radians(12), 0.0, math.radians(2.5)])
"""Standard deviations of a held camera's pitch, yaw and roll; the body's own yaw stands for that of the camera."""
HEIGHT_M, HEIGHT_STD_M = 1.5, 0.3
"""Height of a held camera above the floor."""
LEAN_STD = math.sin(math.radians(3))
"""Standard deviation of a standing torso from the vertical, to each side."""
BALANCE_STD_M = 0.03
"""Standard deviation of the centre of mass from above the line between the feet."""
SOLE_STD_M = 0.015
"""Standard deviation of the height of one sole above the other."""
_SEGMENTS = (
    ("pelvis", "neck", 0.497, 0.5), ("neck", "head", 0.081, 1.0),
    *((f"{side}_{near}", f"{side}_{far}", mass, share) for side in ("left", "right") for near, far, mass, share in (
        ("shoulder", "elbow", 0.028, 0.436), ("elbow", "wrist", 0.022, 0.682),
        ("hip", "knee", 0.1, 0.433), ("knee", "ankle", 0.061, 0.606))),
)  # fmt: skip
"""Parts of a body: joints at its ends, share of the mass, and where its centre is between them (Winter, Biomechanics
and Motor Control of Human Movement, table 4.1)."""


def deviations(body: ShapedBody, pose: BodyPose, camera_height: Float[Tensor, "v"]) -> Float[Tensor, "4 v"]:
    """How far poses [v], and cameras at `camera_height` in their worlds (y up), are from the usual, as standard
    deviations: the torso from the vertical, the centre of mass from above the feet, one sole above the other, and the
    camera above the floor.
    """
    world_from_joint = world_from_joints(pose.joint_rotation, body.joints, PARENTS)
    places = world_from_joint[..., :3, 3] + pose.translation[:, None]
    skinning, soles = world_from_rest(world_from_joint, body.joints), []
    for foot in _feet():
        points = skin(body.vertices[foot], body.model.skin_weights[foot], skinning)
        soles.append(points[..., 1].amin(1) + pose.translation[:, 1])
    left, right = soles
    torso = torch.nn.functional.normalize(_joint(places, "neck") - _joint(places, "pelvis"), dim=-1)
    return torch.stack([
        torso[:, [0, 2]].norm(dim=-1) / LEAN_STD,
        _beside_feet(places) / BALANCE_STD_M,
        (left - right) / SOLE_STD_M,
        (camera_height - torch.minimum(left, right) - HEIGHT_M) / HEIGHT_STD_M,
    ])  # fmt: skip


def _beside_feet(places: Float[Tensor, "v 24 3"]) -> Float[Tensor, "v"]:
    """Horizontal distance of the centre of mass from the line between the feet, metres."""
    centre = torch.stack(
        [mass * torch.lerp(_joint(places, near), _joint(places, far), share) for near, far, mass, share in _SEGMENTS]
    ).sum(0)
    left, right = ((_joint(places, f"{side}_ankle") + _joint(places, f"{side}_foot")) / 2 for side in ("left", "right"))
    across, to_centre = (right - left)[:, [0, 2]], (centre - left)[:, [0, 2]]
    along = (to_centre * across).sum(-1) / across.square().sum(-1).clamp_min(1e-6)
    return (to_centre - along.clamp(0, 1)[:, None] * across).square().sum(-1).add(1e-8).sqrt()


def _joint(places: Float[Tensor, "v 24 3"], name: str) -> Float[Tensor, "v 3"]:
    return places[:, JOINT_NAMES.index(name)]


@functools.cache
def _feet() -> list[Int[Tensor, "n"]]:
    """Vertices of the left and right foot of the default body."""
    nearest = default_body().skin_weights.argmax(1)
    feet = [[JOINT_NAMES.index(f"{side}_{name}") for name in ("ankle", "foot")] for side in ("left", "right")]
    return [torch.isin(nearest, torch.tensor(joints)).nonzero()[:, 0] for joints in feet]
