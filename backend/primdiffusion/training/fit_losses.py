"""Terms of the objective of stage 1 (paper sec. 3.2, L_rec; SPEC 2), on sRGB-encoded images in 0 ... 1."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from primdiffusion.evaluation.pretrained_networks import IMAGENET, VGG19, PictureFeatures, load_matching, read_weights
from primdiffusion.training.fit_config import LossConfig

RESIDUAL = 255 / 16
"""Colours are scaled to 0 ... 255, their residuals by 1 / 16 (SPEC 1.9)."""
DECIMETRES = 10.0
ALPHA_PRIOR_FLOOR = 2.20727
"""-(log 0.1 + log 1.1): the prior is zero where alpha is 0 or 1."""
VGG_LAYERS = ("relu1_2", "relu2_2", "relu3_2", "relu4_2", "relu5_2")
"""SPEC 2 names weights but no layers: the second of each block, as perceptual losses in image synthesis take them."""
VGG_LAYER_WEIGHTS = (20.0, 5.0, 0.9, 0.5, 0.5)
"""SPEC 2."""

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


class PerceptualLoss(nn.Module):
    """Distance of two pictures in the features of VGG19 (SPEC 2; Johnson et al. 2016). Nothing in it learns.

        loss = sum over layers of w_l * mean |F_l(image) - F_l(target)|

    VGG19's weights are not part of this package: a user gives torchvision's file to `load_perceptual`.
    """

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        """Build the loss with random features, which `load_perceptual` replaces."""
        super().__init__()
        self.network = PictureFeatures(VGG19, VGG_LAYERS)
        for name, values in zip(("mean", "std"), IMAGENET, strict=True):
            self.register_buffer(name, torch.tensor(values)[:, None, None], persistent=False)

    def forward(self, image: Float[Tensor, "*b H W 3"], target: Float[Tensor, "*b H W 3"]) -> Float[Tensor, ""]:
        """The loss, mean over the pictures, sRGB-encoded values in [0, 1]; differentiable in `image` only.

        Raises ValueError where shapes differ, or for pictures of fewer than 16 pixels a side.
        """
        if image.shape != target.shape or image.shape[-1] != 3:
            raise ValueError(
                f"pictures of {tuple(image.shape)} and {tuple(target.shape)}: give two of the same shape [..., H, W, 3]"
            )
        with torch.no_grad():
            wanted = self.network(self._prepared(target))
        seen = self.network(self._prepared(image))
        terms = zip(VGG_LAYER_WEIGHTS, seen, wanted, strict=True)
        return torch.stack([weight * (a - b).abs().mean() for weight, a, b in terms]).sum()

    def _prepared(self, pictures: Float[Tensor, "*b H W 3"]) -> Float[Tensor, "n 3 H W"]:
        return (pictures.reshape(-1, *pictures.shape[-3:]).movedim(-1, 1) - self.mean) / self.std


def load_perceptual(path: Path | str) -> PerceptualLoss:
    """The loss with VGG19 from a file in torchvision's layout (vgg19-dcbb9e9d.pth, or its `features` alone).

    Raises:
        FileNotFoundError: there is no such file.
        FileError: it is damaged, or of another network.
    """
    loss = PerceptualLoss()
    load_matching(loss.network, read_weights(path), "torchvision's VGG19", str(path))
    return loss
