"""The marcher's output, and the compositing of a ray's samples to a pixel (SPEC 4)."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.geometry.records import TensorRecord
from primdiffusion.render.image import Background, over, rgba_to_png

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
