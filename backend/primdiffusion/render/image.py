"""Images of primitives: the marcher's output and its compositing (SPEC 4), PNG files, and targets of fits."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from numpy import ndarray
from PIL import Image
from torch import Tensor

from primdiffusion.files.whole_files import atomic_path
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import encode_srgb, to_bytes
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import Frames

Background = tuple[float, float, float]
NEAR_TO_FAR = ((1.0, 0.95, 0.75), (0.98, 0.62, 0.25), (0.80, 0.25, 0.33), (0.42, 0.12, 0.47), (0.10, 0.07, 0.28))
"""Colour ramp of depth images, sRGB-encoded, darker with distance."""


def rgba_to_png(path: str | Path, rgba: Float[Tensor, "h w 4"], background: Background | None) -> None:
    """Write linear RGB premultiplied by alpha, and alpha, as an 8-bit sRGB PNG: see `Rendering.save`."""
    rgb, alpha = rgba[..., :3], rgba[..., 3]
    if background is not None:
        _save(path, encode_srgb(over(rgb, alpha, background)))
        return
    straight = rgb / alpha.clamp_min(1e-6)[..., None]
    _save(path, torch.cat([encode_srgb(straight.clamp(0, 1)), alpha[..., None]], dim=-1))


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
    _save(path, torch.from_numpy(colour * alpha.detach().double().cpu().numpy()[..., None]))


def depth_colours(depth: Float[ndarray, "*r"], near: float, far: float) -> Float64[ndarray, "*r 3"]:
    """Map depth to sRGB-encoded colours, from bright at `near` to dark at `far` (`NEAR_TO_FAR`)."""
    position = np.clip((depth - near) / max(far - near, 1e-9), 0, 1) if near <= far else np.zeros_like(depth)
    stops = np.linspace(0, 1, len(NEAR_TO_FAR))
    return np.stack([np.interp(position, stops, channel) for channel in np.array(NEAR_TO_FAR).T], axis=-1)


def _save(path: str | Path, encoded: Float[Tensor, "h w c"]) -> None:
    with atomic_path(path) as unfinished:
        Image.fromarray(to_bytes(encoded).cpu().numpy()).save(unfinished, format="PNG")


SURFACE_OPACITY = 0.5
"""Accumulated opacity that defines the first hit."""


@dataclasses.dataclass(frozen=True)
class Rendering(TensorRecord):
    """An image of the primitives."""

    rgb: Float[Tensor, "*r 3"]
    """Linear RGB, premultiplied by alpha (over black)."""
    alpha: Float[Tensor, "*r"]
    """Opacity in [0, 1]."""
    depth: Float[Tensor, "*r"]
    """Expected depth: the weighted mean of the samples' distances along the ray, metres; inf where alpha is 0."""
    first_hit: Float[Tensor, "*r"]
    """Distance along the ray, metres, of the first sample at which the opacity has reached 0.5; inf if there is none.
    Not differentiable."""

    def save(self, path: str | Path, background: Background | None = None) -> None:
        """Write an image [h, w] as an 8-bit sRGB PNG: with straight alpha, or over a background (linear RGB).

        The file appears whole or not at all. Raises ValueError for a name that does not end in .png, and OSError.
        """
        if Path(path).suffix.lower() != ".png":
            raise ValueError(f"{path} does not end in .png: pictures are saved as PNG")
        rgba_to_png(path, torch.cat([self.rgb, self.alpha[..., None]], dim=-1), background)

    def over(self, background: Background) -> Float[Tensor, "*r 3"]:
        """The image over a background; both linear RGB."""
        return over(self.rgb, self.alpha, background)


def composite(
    opacity: Float[Tensor, "*r n"], weighted_rgb: Float[Tensor, "*r n 3"], distance: Float[Tensor, "*r n"]
) -> Rendering:
    """Additive, clamped accumulation A <- min(A + a, 1), front to back along the last axis (SPEC 4).

    `opacity` is a = density * window * length >= 0 of each sample, `weighted_rgb` a * colour, `distance` its position
    along the ray (metres). The sample that takes A to 1 contributes the missing part, kappa * a; later samples
    contribute nothing and receive no gradient, so marching may stop there. A sample with a = 0 receives the gradient in
    the limit a -> 0, so empty voxels can become opaque.
    """
    reached = opacity.cumsum(-1)
    missing = 1 - torch.cat([torch.zeros_like(opacity[..., :1]), reached[..., :-1]], dim=-1)
    saturating = (opacity > missing) & (missing > 0)
    part = missing / torch.where(saturating, opacity, torch.ones_like(opacity))
    share = torch.where(saturating, part, (missing > 0).to(opacity.dtype))
    alpha = (share * opacity).sum(-1).clamp_max(1)
    infinity = torch.full_like(alpha, torch.inf)
    visible = alpha > 0
    expected = (share * opacity * distance).sum(-1) / torch.where(visible, alpha, torch.ones_like(alpha))
    surface = torch.where((reached >= SURFACE_OPACITY) & (opacity > 0), distance, infinity[..., None])
    return Rendering(
        rgb=(share[..., None] * weighted_rgb).sum(-2),
        alpha=alpha,
        depth=torch.where(visible, expected, infinity),
        first_hit=torch.cat([surface, infinity[..., None]], dim=-1).amin(-1).detach(),
    )


@dataclasses.dataclass(frozen=True)
class PosedView(TensorRecord):
    """A picture with its camera and the boxes in its pose, unbatched."""

    frames: Frames
    camera: Camera
    rgba: UInt8[Tensor, "height width 4"] | Float32[Tensor, "height width 4"]
    """Colours over black, and the mask: sRGB-encoded bytes for `descend`, linear floats for `fit_payload`."""
    weight: float = 1.0
    """Weight of the picture's mean square error in `fit_payload`."""

    def __post_init__(self) -> None:
        """Raise ValueError if the picture does not fit its camera or is not finite."""
        expected = (self.camera.height, self.camera.width, 4)
        if self.rgba.shape != expected or (self.rgba.is_floating_point() and not self.rgba.isfinite().all()):
            shape = tuple(self.rgba.shape)
            raise ValueError(f"a picture of shape {shape} does not fit its camera, or is not finite: give {expected}")
