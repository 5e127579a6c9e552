"""Metrics of images (PSNR, SSIM, LPIPS, mask IoU; sRGB-encoded RGB in [0, 1]) and distances between sets of samples.

Distances are of features [n, d], computed in float64. Finite sets of one distribution have a distance too: report the
distance between two real sets beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
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


MIN_SAMPLES_PER_DIMENSION = 10
"""With fewer samples per feature, the bias of a Frechet distance is not small beside differences between models."""


def frechet_distance(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> float:
    """Frechet distance |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^1/2) of Gaussians fitted to both (Heusel et al. 2017).

    Covariances are unbiased; the distance is not: it falls with the number of samples, so compare sets of equal size.
    Raises ValueError for fewer than two samples or features of different widths.
    """
    check_features(first, second)
    means, roots = [], []
    for features in (first.double(), second.double()):
        means.append(features.mean(0))
        roots.append((features - means[-1]) / (len(features) - 1) ** 0.5)
    # tr (C1 C2)^1/2 is the nuclear norm of A1 A2^T, where C = A^T A: no square root of a singular matrix is needed.
    overlap = torch.linalg.svdvals(roots[0] @ roots[1].T).sum()
    spread = sum(root.square().sum() for root in roots)
    return float((means[0] - means[1]).square().sum() + spread - 2 * overlap)


def too_few_samples(first: int, second: int, features: int) -> str | None:
    """Warning for sample sizes that bias the Frechet distance; None for sets that are large enough."""
    fewest = MIN_SAMPLES_PER_DIMENSION * features
    if min(first, second) >= fewest:
        return None
    return (
        f"{min(first, second)} samples for {features} features are fewer than {MIN_SAMPLES_PER_DIMENSION} each "
        f"({fewest}): the distance is biased, so compare it only with those of sets of the same sizes"
    )


def cubic_kernel(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """(x.y / d + 1)^3 of every two samples."""
    return (first @ second.T / first.shape[1] + 1) ** 3


def kernel_distance(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> float:
    """Squared maximum mean discrepancy with `cubic_kernel` (KID, Binkowski et al. 2018).

    The unbiased estimate over all samples: 0 on average for two sets of one distribution, so it can be negative. Raises
    ValueError as `frechet_distance`.
    """
    check_features(first, second)
    first, second = first.double(), second.double()
    within = 0.0
    for features in (first, second):
        table = cubic_kernel(features, features)
        within += float((table.sum() - table.trace()) / (len(features) * (len(features) - 1)))
    return within - 2 * float(cubic_kernel(first, second).mean())


class KernelDistances(NamedTuple):
    """The kernel distance over random subsets."""

    mean: float
    std: float
    """Standard deviation of the subsets' distances, biased, as published after +-."""


def kernel_distance_of_subsets(
    first: Float[Tensor, "n d"], second: Float[Tensor, "m d"], subsets: int, size: int, seed: int
) -> KernelDistances:
    """KID as torch-fidelity computes and draws it: `kernel_distance` of `subsets` random subsets of `size` samples.

    Raises ValueError as `frechet_distance`, and if a set has fewer than `size` samples.
    """
    check_features(first, second)
    if not 2 <= size <= min(len(first), len(second)) or subsets < 1:
        raise ValueError(
            f"{subsets} subsets of {size} do not fit sets of {len(first)} and {len(second)} samples: choose a subset "
            "size from 2 to the smaller set's"
        )
    draws = np.random.RandomState(seed)  # torch-fidelity draws from it
    distances = []
    for _ in range(subsets):
        chosen = [torch.from_numpy(draws.choice(len(one), size, replace=False)) for one in (first, second)]
        distances.append(kernel_distance(first[chosen[0]], second[chosen[1]]))
    return KernelDistances(float(np.mean(distances)), float(np.std(distances)))


def check_features(first: Tensor, second: Tensor) -> None:
    """Raise ValueError unless both are features [n, d] and [m, d], n, m > 1."""
    if first.ndim != 2 or second.ndim != 2 or first.shape[1] != second.shape[1] or min(len(first), len(second)) < 2:
        raise ValueError(
            f"features have shapes {tuple(first.shape)} and {tuple(second.shape)}: give [n, d] and [m, d], n, m > 1"
        )
