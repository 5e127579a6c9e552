"""The pictures by which sets of people are compared: everybody in T pose before the same cameras."""

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
"""Pixels a side of a portrait."""
SETTINGS = MarchSettings(step=0.008)
"""8 mm between samples: pixels of whole people are 2 cm wide."""
DISTANCE = 10.0
"""Metres from camera to person: far, so that near and far parts look equally large."""


@dataclasses.dataclass(frozen=True)
class Portrait:
    """One of the views; the default body's pelvis is at the origin."""

    name: str
    yaw: float
    """As in `human.framing`: 0 looks at the face, pi/2 at the left side."""
    middle: float
    """Height above the pelvis that is in the middle, metres."""
    height: float
    """Metres from the lower to the upper edge."""


PORTRAITS = (
    Portrait("front", 0.0, -0.3, 2.16),
    Portrait("back", math.pi, -0.3, 2.16),
    Portrait("left", math.pi / 2, -0.3, 2.16),
    Portrait("head", 0.0, 0.48, 0.6),
)


def camera_of(portrait: Portrait, side: int = SIDE) -> Camera:
    """The view's camera, for pictures of any size."""
    middle = torch.tensor([0.0, portrait.middle, 0.0])
    towards = torch.tensor([math.sin(portrait.yaw), 0.0, math.cos(portrait.yaw)])
    fov = 2 * math.atan(portrait.height / 2 / DISTANCE)
    return look_at(middle + DISTANCE * towards, middle, vertical_fov=fov, width=side, height=side)


def portraits(primitives: Primitives) -> UInt8[Tensor, "4 96 96 4"]:
    """A person's pictures: sRGB-encoded colour premultiplied by alpha, and alpha."""
    pictures = []
    for portrait in PORTRAITS:
        seen = march(primitives, camera_of(portrait), SETTINGS)
        rgba = torch.cat([encode_srgb(seen.rgb.clamp(0, 1)), seen.alpha[..., None]], dim=-1)
        pictures.append((rgba.clamp(0, 1) * 255).round().to(torch.uint8))
    return torch.stack(pictures)
