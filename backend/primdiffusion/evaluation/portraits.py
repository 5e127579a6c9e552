"""The views by which sets of humans are compared: all in T pose, seen by the same cameras."""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import UInt8
from torch import Tensor

from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import MarchSettings, march

SIDE = 96
"""Width and height of a portrait, pixels."""
SETTINGS = MarchSettings(step=0.008)
"""8 mm between samples: in full-body views a pixel is 2 cm wide."""
DISTANCE = 10.0
"""Metres from camera to human: large, so that perspective is weak."""


@dataclasses.dataclass(frozen=True)
class Portrait:
    """One view; the default body's pelvis is at the origin."""

    name: str
    yaw: float
    """As in `human.framing`: 0 looks at the face, pi/2 at the left side."""
    middle: float
    """Height of the image centre above the pelvis, metres."""
    height: float
    """Height of the view, metres."""


PORTRAITS = (
    Portrait("front", 0.0, -0.3, 2.16),
    Portrait("back", math.pi, -0.3, 2.16),
    Portrait("left", math.pi / 2, -0.3, 2.16),
    Portrait("head", 0.0, 0.48, 0.6),
)


def camera_of(portrait: Portrait, side: int = SIDE) -> Camera:
    """The camera of a view."""
    middle = torch.tensor([0.0, portrait.middle, 0.0])
    towards = torch.tensor([math.sin(portrait.yaw), 0.0, math.cos(portrait.yaw)])
    fov = 2 * math.atan(portrait.height / 2 / DISTANCE)
    return look_at(middle + DISTANCE * towards, middle, vertical_fov=fov, width=side, height=side)


def portraits(primitives: Primitives) -> UInt8[Tensor, "4 96 96 4"]:
    """Render all views: sRGB-encoded colour premultiplied by alpha, and alpha."""
    pictures = []
    for portrait in PORTRAITS:
        seen = march(primitives, camera_of(portrait), SETTINGS)
        rgba = torch.cat([encode_srgb(seen.rgb.clamp(0, 1)), seen.alpha[..., None]], dim=-1)
        pictures.append((rgba.clamp(0, 1) * 255).round().to(torch.uint8))
    return torch.stack(pictures)
