"""The views by which sets of humans are compared: all in T pose, seen by the same cameras."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.rasterise import rasterise_colourings
from primdiffusion.render.march import MarchSettings, march

SIDE = 256
"""Width and height of a portrait, pixels: enough to see whether a face is sharp."""
SETTINGS = MarchSettings(step=0.008)
"""8 mm between samples: in full-body views a pixel is 8 mm wide."""
SUPERSAMPLE = 3
"""Samples along a pixel's side in portraits of meshes."""
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


def portraits(primitives: Primitives) -> UInt8[Tensor, "v h w 4"]:
    """Render all views: sRGB-encoded colour premultiplied by alpha, and alpha."""
    seen = (march(primitives, camera_of(portrait), SETTINGS) for portrait in PORTRAITS)
    return torch.stack([_encoded(view.rgb, view.alpha) for view in seen])


def mesh_portraits(colourings: Sequence[TexturedMesh]) -> UInt8[Tensor, "n v h w 4"]:
    """Portraits of meshes in T pose that differ only in their textures, as `portraits` of boxes."""
    views = []
    for portrait in PORTRAITS:
        seen = rasterise_colourings(colourings, camera_of(portrait), SUPERSAMPLE)
        views.append([_encoded(torch.from_numpy(view.rgb), torch.from_numpy(view.alpha)) for view in seen])
    return torch.stack([torch.stack(own) for own in zip(*views, strict=True)])


def _encoded(rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w 4"]:
    rgba = torch.cat([encode_srgb(rgb.clamp(0, 1)), alpha[..., None]], dim=-1)
    return (rgba.clamp(0, 1) * 255).round().to(torch.uint8)
