"""Terms of stage 1's objective (paper sec. 3.2, L_rec; SPEC 2), on sRGB-encoded pictures in 0 ... 1."""

from __future__ import annotations

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from primdiffusion.training.fit_config import LossConfig

RESIDUAL = 255 / 16
"""Colours count 0 ... 255, their residuals by 1 / 16 (SPEC 1.9)."""
DECIMETRES = 10.0
ALPHA_PRIOR_FLOOR = 2.20727
"""-(log 0.1 + log 1.1): the prior is zero where alpha is 0 or 1."""

Picture = Float[Tensor, "*b H W 3"]
Features = Callable[[Picture, Picture], Tensor]


def rgb_loss(image: Picture, target: Picture) -> Tensor:
    """L_rgb: mean square residual of the colours in 0 ... 255, divided by 16 (SPEC 2)."""
    return (RESIDUAL * (image - target)).square().mean()


def silhouette_loss(alpha: Float[Tensor, "*b H W"], mask: Float[Tensor, "*b H W"]) -> Tensor:
    """L_sil: mean absolute difference of what boxes and the person cover of each pixel."""
    return (alpha - mask).abs().mean()


def volume_loss(half_extent: Float[Tensor, "*b K 3"]) -> Tensor:
    """L_vol: the sum over the boxes of the product of their three half extents, in decimetres; mean over people."""
    return (DECIMETRES * half_extent).prod(-1).sum(-1).mean()


def alpha_prior(alpha: Float[Tensor, "*b H W"]) -> Tensor:
    """Zero where alpha is 0 or 1, 1.19 where it is a half: the released code's taste for solid silhouettes (SPEC 2)."""
    return ((0.1 + alpha).log() + (1.1 - alpha).log() + ALPHA_PRIOR_FLOOR).mean()


def loss_terms(
    image: Picture,
    alpha: Float[Tensor, "*b H W"],
    half_extent: Float[Tensor, "*c K 3"],
    target: Picture,
    mask: Float[Tensor, "*b H W"],
    weights: LossConfig,
    perceptual: Features | None = None,
) -> dict[str, Tensor]:
    """The terms that have a weight, by name, weighted: their sum is the objective.

    Raises:
        ValueError: the perceptual loss has a weight, but its function is not given.
    """
    if weights.perceptual and perceptual is None:
        raise ValueError("the perceptual loss has a weight but no features: give those of `load_perceptual`")
    terms: dict[str, Callable[[], Tensor]] = {
        "rgb": lambda: rgb_loss(image, target),
        "silhouette": lambda: silhouette_loss(alpha, mask),
        "volume": lambda: volume_loss(half_extent),
        "alpha_prior": lambda: alpha_prior(alpha),
    }
    if perceptual is not None:
        terms["perceptual"] = lambda: perceptual(image, target)
    weight = {name: float(getattr(weights, name)) for name in terms}
    return {name: weight[name] * term() for name, term in terms.items() if weight[name]}
