"""Terms of the objective of stage 1 (paper sec. 3.2, L_rec; SPEC 2), on sRGB-encoded images in 0 ... 1."""

from __future__ import annotations

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from primdiffusion.training.fit_config import LossConfig

RESIDUAL = 255 / 16
"""Colours are scaled to 0 ... 255, their residuals by 1 / 16 (SPEC 1.9)."""
DECIMETRES = 10.0
ALPHA_PRIOR_FLOOR = 2.20727
"""-(log 0.1 + log 1.1): the prior is zero where alpha is 0 or 1."""

Picture = Float[Tensor, "*b H W 3"]
Features = Callable[[Picture, Picture], Tensor]


def rgb_loss(image: Picture, target: Picture) -> Tensor:
    """L_rgb: mean square residual of the colours in 0 ... 255, divided by 16 (SPEC 2)."""
    return (RESIDUAL * (image - target)).square().mean()


def silhouette_loss(alpha: Float[Tensor, "*b H W"], mask: Float[Tensor, "*b H W"]) -> Tensor:
    """L_sil: mean absolute difference of alpha and mask."""
    return (alpha - mask).abs().mean()


def volume_loss(half_extent: Float[Tensor, "*b K 3"]) -> Tensor:
    """L_vol: sum over the boxes of the product of their half extents, in decimetres; mean over the batch."""
    return (DECIMETRES * half_extent).prod(-1).sum(-1).mean()


def alpha_prior(alpha: Float[Tensor, "*b H W"]) -> Tensor:
    """The released code's prior (SPEC 2): 0 for an alpha of 0 or 1, 1.19 for one half."""
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
    """Return the weighted terms with a weight, by name; the objective is their sum.

    Raises:
        ValueError: the perceptual loss has a weight, but its function is not given.
    """
    if weights.perceptual and perceptual is None:
        raise ValueError("the perceptual loss has a weight but no features: pass those of `load_perceptual`")
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
