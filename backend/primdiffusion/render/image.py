"""Renderings as picture files, and boxes drawn as boxes."""

from __future__ import annotations

import colorsys
import dataclasses
import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from PIL import Image
from torch import Tensor

from primdiffusion.geometry.srgb import decode_srgb, encode_srgb
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.compositing import Rendering

__all__ = ["as_boxes", "decode_srgb", "depth_to_png", "encode_srgb", "over", "to_png"]

Background = tuple[float, float, float]
BOX_DENSITY = 1e5
"""1/m: boxes drawn as boxes are opaque within a sample, almost up to their faces in spite of the window."""
NEAR_TO_FAR = ((1.0, 0.95, 0.75), (0.98, 0.62, 0.25), (0.80, 0.25, 0.33), (0.42, 0.12, 0.47), (0.10, 0.07, 0.28))
"""Encoded sRGB of the depth picture, brightness falling with distance."""


def over(rendering: Rendering, background: Background) -> Float[Tensor, "*r 3"]:
    """The rendering's linear colours over a plain linear background."""
    behind = torch.tensor(background).to(rendering.rgb)
    return rendering.rgb + (1 - rendering.alpha)[..., None] * behind


def to_png(path: str | Path, rendering: Rendering, background: Background | None = (0.0, 0.0, 0.0)) -> None:
    """Writes an 8 bit sRGB picture: over `background` (linear RGB), or with straight alpha where that is None.

    A reader never sees half a file: it is written beside `path` and renamed.
    """
    if background is not None:
        _save(path, _to_bytes(encode_srgb(over(rendering, background))))
        return
    straight = rendering.rgb / rendering.alpha.clamp_min(1e-6)[..., None]
    _save(path, _to_bytes(torch.cat([encode_srgb(straight.clamp(0, 1)), rendering.alpha[..., None]], dim=-1)))


def depth_to_png(
    path: str | Path, rendering: Rendering, *, near: float | None = None, far: float | None = None
) -> None:
    """Writes the expected depth in colours, bright where near, black where nothing is seen.

    The colours span `near` to `far` (metres), by default the smallest and largest depth of pixels at least half opaque.
    """
    depth = rendering.depth.detach().double().cpu().numpy()
    solid = depth[(rendering.alpha >= 0.5).cpu().numpy()]
    near = near if near is not None else float(solid.min(initial=np.inf))
    far = far if far is not None else float(solid.max(initial=-np.inf))
    place = np.clip((depth - near) / max(far - near, 1e-9), 0, 1) if near <= far else np.zeros_like(depth)
    stops = np.linspace(0, 1, len(NEAR_TO_FAR))
    colour = np.stack([np.interp(place, stops, channel) for channel in np.array(NEAR_TO_FAR).T], axis=-1)
    alpha = rendering.alpha.detach().double().cpu().numpy()[..., None]
    _save(path, _to_bytes(torch.from_numpy(colour * alpha)))


def as_boxes(primitives: Primitives, group: Int[Tensor, "k"] | None = None) -> Primitives:
    """The same boxes filled with one opaque colour each, so that the marcher draws the boxes and not what they hold.

    Boxes of one `group` (say, a UV chart) share a hue and differ in lightness; without groups hues differ.
    """
    k = torch.arange(primitives.position.shape[-2])
    shade = (k * 0.618034) % 1
    hue = (torch.as_tensor(group).cpu() * 0.618034) % 1 if group is not None else shade
    lightness = 0.35 + 0.35 * ((k * 0.754878) % 1)
    colours = [colorsys.hls_to_rgb(float(h), float(light), 0.75) for h, light in zip(hue, lightness, strict=True)]
    rgb = decode_srgb(torch.tensor(colours, dtype=torch.float32).reshape(-1, 3)).to(primitives.rgb)
    return dataclasses.replace(
        primitives,
        rgb=rgb[..., None, None, None].expand_as(primitives.rgb).contiguous(),
        density=torch.full_like(primitives.density, BOX_DENSITY),
    )


def _to_bytes(values: Float[Tensor, "h w c"]) -> UInt8[ndarray, "h w c"]:
    return (values.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def _save(path: str | Path, pixels: UInt8[ndarray, "h w c"]) -> None:
    target = Path(path)
    unfinished = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        Image.fromarray(pixels).save(unfinished, format="PNG")
        os.replace(unfinished, target)
    finally:
        unfinished.unlink(missing_ok=True)
