"""What a marcher returns, and how the samples of a ray become a pixel (SPEC 4)."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.geometry.records import TensorRecord

SURFACE_OPACITY = 0.5
"""The accumulated opacity that counts as having hit something."""


@dataclasses.dataclass(frozen=True)
class Rendering(TensorRecord):
    """One picture of the primitives."""

    rgb: Float[Tensor, "*r 3"]
    """Linear RGB, premultiplied by alpha (over black)."""
    alpha: Float[Tensor, "*r"]
    """Opacity in [0, 1]."""
    depth: Float[Tensor, "*r"]
    """Expected depth: the weighted mean of the samples' distances along the ray, metres; inf where alpha is 0."""
    first_hit: Float[Tensor, "*r"]
    """Distance along the ray, metres, of the first sample at which the opacity has reached 0.5; inf where it never
    does. Not differentiable."""


def composite(
    opacity: Float[Tensor, "*r n"], weighted_rgb: Float[Tensor, "*r n 3"], distance: Float[Tensor, "*r n"]
) -> Rendering:
    """Additive, clamped accumulation A <- min(A + a, 1), front to back along the last axis (SPEC 4).

    `opacity` are the samples' a = density * window * length >= 0, `weighted_rgb` their a * colour, `distance` their
    places along the ray (metres). The sample that takes A to 1 counts with the part that was missing (kappa * a); those
    after it not at all, nor do they receive a gradient, so stopping there loses nothing. A sample with a = 0 has the
    gradient of one that is barely there: what is empty can become something.
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
