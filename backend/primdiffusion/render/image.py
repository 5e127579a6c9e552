"""Write renderings as PNG files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from numpy import ndarray
from PIL import Image
from torch import Tensor

from primdiffusion.files.whole_files import written_whole
from primdiffusion.geometry.srgb import encode_srgb

Background = tuple[float, float, float]
NEAR_TO_FAR = ((1.0, 0.95, 0.75), (0.98, 0.62, 0.25), (0.80, 0.25, 0.33), (0.42, 0.12, 0.47), (0.10, 0.07, 0.28))
"""Colour ramp of depth images, sRGB-encoded, darker with distance."""


def rgba_to_png(path: str | Path, rgba: Float[Tensor, "h w 4"], background: Background | None) -> None:
    """Write linear RGB premultiplied by alpha, and alpha, as an 8-bit sRGB PNG: see `Rendering.save`."""
    rgb, alpha = rgba[..., :3], rgba[..., 3]
    if background is not None:
        _save(path, _to_bytes(encode_srgb(over(rgb, alpha, background))))
        return
    straight = rgb / alpha.clamp_min(1e-6)[..., None]
    _save(path, _to_bytes(torch.cat([encode_srgb(straight.clamp(0, 1)), alpha[..., None]], dim=-1)))


def over(rgb: Float[Tensor, "*r 3"], alpha: Float[Tensor, "*r"], background: Background) -> Float[Tensor, "*r 3"]:
    """Composite premultiplied colours over a linear background colour."""
    return rgb + (1 - alpha)[..., None] * torch.tensor(background).to(rgb)


def depth_to_png(path: str | Path, distance: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]) -> None:
    """Write the expected depth in false colours, bright for near, black for background.

    The ramp spans the range of depth of pixels with alpha of at least 0.5.
    """
    depth = distance.detach().double().cpu().numpy()
    solid = depth[(alpha >= 0.5).cpu().numpy()]
    colour = depth_colours(depth, float(solid.min(initial=np.inf)), float(solid.max(initial=-np.inf)))
    _save(path, _to_bytes(torch.from_numpy(colour * alpha.detach().double().cpu().numpy()[..., None])))


def depth_colours(depth: Float[ndarray, "*r"], near: float, far: float) -> Float64[ndarray, "*r 3"]:
    """Map depth to sRGB-encoded colours, from bright at `near` to dark at `far` (`NEAR_TO_FAR`)."""
    position = np.clip((depth - near) / max(far - near, 1e-9), 0, 1) if near <= far else np.zeros_like(depth)
    stops = np.linspace(0, 1, len(NEAR_TO_FAR))
    return np.stack([np.interp(position, stops, channel) for channel in np.array(NEAR_TO_FAR).T], axis=-1)


def _to_bytes(values: Float[Tensor, "h w c"]) -> UInt8[ndarray, "h w c"]:
    return (values.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def _save(path: str | Path, pixels: UInt8[ndarray, "h w c"]) -> None:
    with written_whole(path) as unfinished:
        Image.fromarray(pixels).save(unfinished, format="PNG")
