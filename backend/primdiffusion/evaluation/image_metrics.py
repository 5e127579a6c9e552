"""Image metrics: PSNR, SSIM, LPIPS and mask IoU. Images are sRGB-encoded RGB in [0, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from primdiffusion.evaluation.pretrained_networks import (
    ALEXNET,
    VGG16,
    Architecture,
    PictureFeatures,
    load_matching,
    read_weights,
)
from primdiffusion.files.regular_files import FileError
from primdiffusion.runtime.failures import optional_package

WINDOW = 11
"""Width of SSIM's Gaussian window, pixels."""
LARGEST_PSNR = 100.0
"""PSNR of equal images, dB: keeps means finite."""
LPIPS_LAYERS = {
    "VGG16": ("relu1_2", "relu2_2", "relu3_3", "relu4_3", "relu5_3"),
    "AlexNet": ("relu1_1", "relu2_1", "relu3_1", "relu3_2", "relu3_3"),
}
LPIPS_SHIFT, LPIPS_SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Normalisation of LPIPS' inputs in [-1, 1]."""


class Box(NamedTuple):
    """A rectangle in pixels; right and bottom are exclusive."""

    left: int
    top: int
    right: int
    bottom: int

    def cut(self, picture: Float[Tensor, "*b H W c"]) -> Float[Tensor, "*b h w c"]:
        """Crop images to the box."""
        return picture[..., self.top : self.bottom, self.left : self.right, :]


def psnr(image: Float[Tensor, "*b H W 3"], target: Float[Tensor, "*b H W 3"]) -> Float[Tensor, "*b"]:
    """Peak signal-to-noise ratio of each image, -10 log10 mean (I - I*)^2, dB; at most `LARGEST_PSNR`.

    Raises ValueError if shapes differ.
    """
    _check_pair(image, target)
    squared = (image - target).square().mean((-3, -2, -1))
    return -10 * squared.clamp_min(10 ** (-LARGEST_PSNR / 10)).log10()


def ssim(image: Float[Tensor, "*b H W 3"], target: Float[Tensor, "*b H W 3"]) -> Float[Tensor, "*b"]:
    """Structural similarity of each image (Wang et al. 2004, eq. 13), mean over channels and windows.

    Gaussian windows of 11 x 11 pixels, sigma 1.5, biased variances; windows that cross the border are left out, as in
    Wang et al.'s program and scikit-image. Raises ValueError if shapes differ or a side has fewer than 11 pixels, and
    MissingPackageError without the extra `training`.
    """
    metrics = optional_package("torchmetrics.functional.image", "training")
    _check_pair(image, target)
    height, width = image.shape[-3:-1]
    if min(height, width) < WINDOW:
        raise ValueError(f"images have {width} x {height} pixels: SSIM needs at least {WINDOW} x {WINDOW}")
    one, other = (picture.reshape(-1, height, width, 3).movedim(-1, 1) for picture in (image, target))
    # Its own mean takes windows across the border too, in mirrored images.
    _, windows = metrics.structural_similarity_index_measure(
        one, other, data_range=1.0, reduction="none", return_full_image=True
    )
    inside = slice(WINDOW // 2, -(WINDOW // 2))
    return windows[..., inside, inside].mean((-3, -2, -1)).reshape(image.shape[:-3])


def overlap(first: Bool[Tensor, "H W"], second: Bool[Tensor, "H W"]) -> float:
    """Intersection over union of two masks; 1 if both are empty."""
    union = int((first | second).sum())
    return int((first & second).sum()) / union if union else 1.0


def bounding_box(mask: Bool[Tensor, "H W"]) -> Box | None:
    """Bounding box of a mask, grown to SSIM's 11 pixels a side if the image is large enough; None for an empty mask."""
    if not mask.any():
        return None
    left, right = _interval(mask.any(0))
    top, bottom = _interval(mask.any(1))
    return Box(left, top, right, bottom)


def _interval(covered: Bool[Tensor, "n"]) -> tuple[int, int]:
    indices = covered.nonzero()[:, 0]
    low, high = int(indices[0]), int(indices[-1]) + 1
    length = min(max(high - low, WINDOW), len(covered))
    low = min(max((low + high - length) // 2, 0), len(covered) - length)
    return low, low + length


class Lpips(nn.Module):
    """Learned perceptual distance (Zhang et al. 2018); 0 for equal images. Its weights come from files."""

    shift: Tensor
    scale: Tensor

    def __init__(self, architecture: Architecture) -> None:
        """Initialise with random weights, which `load_lpips` replaces. `architecture` is VGG16 or ALEXNET."""
        super().__init__()
        taps = LPIPS_LAYERS[architecture.name]
        self.network = PictureFeatures(architecture, taps)
        channels = [layer.out_channels for layer in self.network.features if isinstance(layer, nn.Conv2d)]
        names = [
            f"relu{block}_{number}"
            for block, layers in enumerate(architecture.blocks, start=1)
            for number in range(1, len(layers) + 1)
        ]
        widths = [channels[names.index(tap)] for tap in taps]
        self.linear = nn.ModuleList(nn.Conv2d(width, 1, 1, bias=False) for width in widths)
        for name, values in (("shift", LPIPS_SHIFT), ("scale", LPIPS_SCALE)):
            self.register_buffer(name, torch.tensor(values)[:, None, None], persistent=False)
        self.requires_grad_(False).eval()

    def forward(self, image: Float[Tensor, "*b H W 3"], target: Float[Tensor, "*b H W 3"]) -> Float[Tensor, "*b"]:
        """Distance of each image; differentiable. Raises ValueError if shapes differ or images are too small."""
        _check_pair(image, target)
        distance = image.new_zeros(())
        pairs = zip(self._features(image), self._features(target), self.linear, strict=True)
        for seen, wanted, linear in pairs:
            distance = distance + linear((seen - wanted).square()).mean((-3, -2, -1))
        return distance.reshape(image.shape[:-3])

    def _features(self, pictures: Float[Tensor, "*b H W 3"]) -> list[Tensor]:
        """Features of unit length at every pixel."""
        signed = 2 * pictures.reshape(-1, *pictures.shape[-3:]).movedim(-1, 1) - 1
        layers = self.network((signed - self.shift) / self.scale)
        # The epsilon keeps the gradient of the square root finite at zero.
        return [layer / (layer.square().sum(1, keepdim=True) + 1e-20).sqrt() for layer in layers]


def load_lpips(paths: Sequence[Path | str]) -> Lpips:
    """Load LPIPS from weights files, which determine the architecture: VGG16 or AlexNet.

    Either one file with everything (the state_dict of lpips.LPIPS or of torchmetrics' equivalent), or two: the backbone
    from torchvision, and the linear weights (alex.pth or vgg.pth of lpips or torchmetrics).

    Raises:
        FileNotFoundError: a file is missing.
        FileError: a file is damaged, weights are missing, or the files are of two architectures.
    """
    source = " and ".join(str(path) for path in paths)
    weights: dict[str, Tensor] = {}
    for path in paths:
        weights |= {_own_name(name): value for name, value in read_weights(path).items()}
    what = "torchvision's VGG16 or AlexNet and LPIPS' linear weights of the same network"
    first = weights.get("network.features.0.weight")
    if first is None:
        raise FileError(source or "an empty list", "has no backbone weights", f"give {what}")
    lpips = Lpips(ALEXNET if tuple(first.shape[-2:]) == (11, 11) else VGG16)
    load_matching(lpips, weights, what, source)
    return lpips


def _own_name(name: str) -> str:
    """Map names of lpips (lin2.model.1.weight, lins.2..., net.slice3.6.weight) and torchvision (features.6.weight)."""
    parts = name.removeprefix("lins.").removeprefix("lin").removeprefix("net.").split(".")
    if name.startswith("lin") and parts[1:3] == ["model", "1"]:
        return f"linear.{parts[0]}.weight"
    if parts[0].startswith("slice") or parts[0] == "features":
        return f"network.features.{'.'.join(parts[1:])}"
    return name


def _check_pair(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape or image.ndim < 3 or image.shape[-1] != 3:
        raise ValueError(
            f"images have shapes {tuple(image.shape)} and {tuple(target.shape)}: give two of shape [..., H, W, 3]"
        )
