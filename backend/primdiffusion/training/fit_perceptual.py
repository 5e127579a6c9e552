"""The perceptual loss: how far two pictures lie apart in the features of VGG19 (SPEC 2; Johnson et al. 2016).

    loss = sum over layers of w_l * mean |F_l(image) - F_l(target)|

VGG19's weights are not part of this package: a user gives torchvision's file.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from primdiffusion.evaluation.pretrained_networks import VGG19, PictureFeatures, fill, read_weights

LAYERS = ("relu1_2", "relu2_2", "relu3_2", "relu4_2", "relu5_2")
"""SPEC 2 names weights but no layers: the second of each block, as perceptual losses in image synthesis take them."""
LAYER_WEIGHTS = (20.0, 5.0, 0.9, 0.5, 0.5)
"""SPEC 2."""
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of sRGB-encoded values in [0, 1]: what torchvision's networks were trained on."""


class PerceptualLoss(nn.Module):
    """The loss as a function of two pictures. It has no parameters that learn."""

    mean: Tensor
    std: Tensor

    def __init__(self, layers: Sequence[str] = LAYERS, weights: Sequence[float] = LAYER_WEIGHTS) -> None:
        """With random features, until `load_perceptual` fills them.

        Raises ValueError for an unknown layer, or another number of weights than of layers.
        """
        super().__init__()
        if len(layers) != len(weights) or not layers:
            raise ValueError(f"{len(layers)} layers and {len(weights)} weights: give a weight for each layer")
        self.network = PictureFeatures(VGG19, layers)
        self.layer_weights = tuple(weights)
        for name, values in (("mean", IMAGENET_MEAN), ("std", IMAGENET_STD)):
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
        terms = zip(self.layer_weights, seen, wanted, strict=True)
        return torch.stack([weight * (a - b).abs().mean() for weight, a, b in terms]).sum()

    def _prepared(self, pictures: Float[Tensor, "*b H W 3"]) -> Float[Tensor, "n 3 H W"]:
        return (pictures.reshape(-1, *pictures.shape[-3:]).movedim(-1, 1) - self.mean) / self.std


def load_perceptual(
    path: Path | str, layers: Sequence[str] = LAYERS, weights: Sequence[float] = LAYER_WEIGHTS
) -> PerceptualLoss:
    """The loss with VGG19 from a file in torchvision's layout (vgg19-dcbb9e9d.pth, or its `features` alone).

    Raises:
        FileNotFoundError: there is no such file.
        WeightsFileError: it is damaged, or of another network.
        ValueError: as `PerceptualLoss`.
    """
    loss = PerceptualLoss(layers, weights)
    fill(loss.network, read_weights(path), "torchvision's VGG19", str(path))
    return loss
