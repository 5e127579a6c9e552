"""A small network of joints, depth and attributes of a human in a picture, trained on renders of MakeHuman meshes; and
the errors of joints and depth that such networks are used to measure (PCKh, SPEC 7).

It needs no weights of others: `weights/pose_depth.safetensors` ships with the package. Trained by
scripts/train_pose_depth_network.py; its card states its errors on renders of held-out meshes.
"""

from __future__ import annotations

import importlib.resources
import itertools
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.capture.coco import JOINTS
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.files import tensor_file
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import as_file_error

INPUT = 128
"""Width and height of what the network sees, pixels: pictures are averaged down to it."""
CELLS = 32
"""Width and height of heatmaps and depth."""
WIDTHS = (24, 48, 96, 120, 112)
"""Channels at 64, 32, 16, 8 and 4 cells."""
FEATURES = 64
WINDOW = 2
"""Cells to each side of a heatmap's maximum over which the joint's position is averaged."""
DETAIL_SIDE = 256
"""Size of the pictures whose fine detail is measured."""
BANDS = (1.0, 2.0, 4.0)
"""Standard deviations, in pixels, of the Gaussians whose differences are bands of detail: finer than each."""
PCK_SHARE = 0.5
"""A joint is correct within this share of the head size: PCKh@0.5."""
FLAT = 1e-9
"""Variance, relative to the mean's square, below which a map is constant."""


class Seen(NamedTuple):
    """Outputs of the network for n pictures."""

    heatmaps: Float[Tensor, "n 12 32 32"]
    """Logits of each joint's cell."""
    depth: Float[Tensor, "n 32 32"]
    """Inverted depth up to scale and offset."""
    features: Float[Tensor, "n 64"]
    """Learned features, of unit variance over the training pictures."""


class ResidualStage(nn.Module):
    """A convolution that halves width and height, then one that keeps them, with batch normalisation."""

    def __init__(self, channels: int, out: int, convolutions: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for number in range(convolutions):
            stride = 2 if number == 0 else 1
            layers += [nn.Conv2d(channels, out, 3, stride, 1, bias=False), nn.BatchNorm2d(out), nn.ReLU()]
            channels = out
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(x)


class PoseDepthNetwork(nn.Module):
    """A U-Net from 128 x 128 pictures to 32 x 32 cells, with attributes predicted from its coarsest stages."""

    def __init__(self, vocabulary: AttributeVocabulary) -> None:
        super().__init__()
        self.vocabulary = vocabulary
        self.card: dict[str, Any] = {}
        self.down = nn.ModuleList(
            ResidualStage(before, out, count)
            for before, out, count in zip((3, *WIDTHS), WIDTHS, (1, 1, 2, 2, 2), strict=False)
        )
        lower = WIDTHS[:0:-1]
        self.lateral = nn.ModuleList(nn.Conv2d(before, out, 1) for before, out in itertools.pairwise(lower))
        self.up = nn.ModuleList(
            nn.Sequential(nn.Conv2d(out, out, 3, 1, 1, bias=False), nn.BatchNorm2d(out), nn.ReLU()) for out in lower[1:]
        )
        self.cells = nn.Conv2d(WIDTHS[1], len(JOINTS) + 1, 1)
        # Batch normalisation gives each feature unit variance over the training set: the unit of distances.
        self.features = nn.Sequential(
            nn.Dropout(0.2), nn.Linear((WIDTHS[3] + WIDTHS[4]) * 4, FEATURES), nn.BatchNorm1d(FEATURES, affine=False)
        )
        self.heads = attribute_heads(vocabulary, FEATURES)

    def forward(self, pictures: Float[Tensor, "n 3 128 128"]) -> Seen:
        """Read sRGB-encoded pictures in [0, 1]."""
        x, stages = 2 * pictures - 1, []
        for stage in self.down:
            x = stage(x)
            stages.append(x)
        pooled = [functional.adaptive_avg_pool2d(one, 2).flatten(1) for one in stages[-2:]]
        for lateral, up, skip in zip(self.lateral, self.up, stages[-2:0:-1], strict=True):
            x = up(functional.interpolate(lateral(x), scale_factor=2.0, mode="nearest") + skip)
        cells = self.cells(x)
        return Seen(cells[:, :-1], cells[:, -1], self.features(torch.cat(pooled, 1)))


def shrunk(rgb: UInt8[Tensor, "h w 3"]) -> UInt8[Tensor, "3 128 128"]:
    """A square picture averaged down to what the network sees."""
    values = functional.interpolate(rgb.movedim(-1, 0)[None].float(), (INPUT, INPUT), mode="area")[0]
    return values.round().to(torch.uint8)


def joint_positions(heatmaps: Float[Tensor, "n k c c"]) -> Float[Tensor, "n k 2"]:
    """x, y of each joint in [0, 1] of the picture: the mean of the heatmap within WINDOW cells of its maximum."""
    count, joints, height, width = heatmaps.shape
    best = heatmaps.flatten(2).argmax(-1)
    row, column = torch.arange(height)[:, None], torch.arange(width)
    top, left = (best // width)[..., None, None], (best % width)[..., None, None]
    near = ((row - top).abs() <= WINDOW) & ((column - left).abs() <= WINDOW)
    weight = heatmaps.masked_fill(~near, -torch.inf).flatten(2).softmax(-1).unflatten(2, (height, width))
    x = (weight.sum(-2) * (column + 0.5)).sum(-1) / width
    y = (weight.sum(-1) * (row[:, 0] + 0.5)).sum(-1) / height
    return torch.stack([x, y], -1).reshape(count, joints, 2)


def detail_of(rgb: UInt8[Tensor, "h w 3"], mask: Tensor) -> Float[Tensor, "3"]:
    """Logarithm of the energy of fine detail inside the human, at DETAIL_SIDE pixels (`detail_energies`)."""
    rgba = torch.cat([rgb.float() * mask[..., None], 255.0 * mask[..., None]], -1)
    rgba = functional.interpolate(rgba.movedim(-1, 0)[None], (DETAIL_SIDE, DETAIL_SIDE), mode="area")
    return detail_energies(rgba.movedim(1, -1)[:, None].round().to(torch.uint8))[0]


def cell_means(values: Float[Tensor, "h w"], mask: Tensor) -> Float[Tensor, "32 32"]:
    """Mean over the masked pixels of each cell; 0 where less than half of a cell is masked."""
    share = functional.adaptive_avg_pool2d(mask[None, None].float(), CELLS)[0, 0]
    means = functional.adaptive_avg_pool2d((values * mask)[None, None], CELLS)[0, 0]
    return torch.where(share >= 0.5, means / share.clamp_min(1e-6), 0.0)


def load_pose_depth_network(path: Path | None = None) -> PoseDepthNetwork:
    """Load the network that ships with the package, or another file.

    Raises FileNotFoundError, and ValueError for an unreadable file.
    """
    if path is None:
        packaged = importlib.resources.files("primdiffusion.weights") / "pose_depth.safetensors"
        with importlib.resources.as_file(packaged) as found:
            return load_pose_depth_network(found)
    if not path.is_file():
        raise FileNotFoundError(f"no network of joints and depth at {path}: install the package again")
    reason = "is not a network of joints and depth of this version"
    with as_file_error(path, reason, "install the package again", OSError, RuntimeError):
        tensors, metadata = tensor_file.read(path)
        vocabulary = AttributeVocabulary.from_json(parse_json(metadata["space"]))
        network = tensor_file.load_network(lambda: PoseDepthNetwork(vocabulary), tensors)
        network.card = dict(parse_json(metadata["card"]))
    return network.eval().requires_grad_(False)


def correct_joints(found: Float[Tensor, "k 2"], true: Float[Tensor, "k 2"], head_size: float) -> Bool[Tensor, "k"]:
    """Whether each joint is within PCK_SHARE of the head size of the true one (PCKh, Andriluka et al. 2014).

    Raises ValueError for different shapes or a head size that is not positive.
    """
    if found.shape != true.shape or found.ndim != 2 or found.shape[-1] != 2:
        raise ValueError(f"joints have shapes {tuple(found.shape)} and {tuple(true.shape)}: give two of [k, 2]")
    if not head_size > 0:
        raise ValueError(f"the head size is {head_size} pixels: give the distance of two joints of the head")
    return (found - true).norm(dim=-1) <= PCK_SHARE * head_size


def depth_error(
    inverted: Float[Tensor, "h w"], true_depth: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]
) -> float | None:
    """Mean squared difference of inverted depths inside the mask, after aligning means and standard deviations.

    Monocular networks predict inverted depth up to scale and offset, so both maps get mean 0 and variance 1 inside the
    mask: the error is 0 for a positive affine map of 1 / `true_depth`, and 2 (1 - correlation) in general, 2 for a map
    that is unrelated or constant. None where fewer than two pixels, or a flat surface, are left to compare.
    """
    seen = mask & torch.isfinite(true_depth) & (true_depth > 0) & torch.isfinite(inverted)
    if int(seen.sum()) < 2:
        return None
    true, ours = 1 / true_depth[seen].double(), inverted[seen].double()
    if float(true.var(correction=0)) <= FLAT * float(true.square().mean()):
        return None
    if float(ours.var(correction=0)) <= FLAT * float(ours.square().mean()):
        return 2.0
    return float((_standardised(true) - _standardised(ours)).square().mean())


def _standardised(values: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    return (values - values.mean()) / values.std(correction=0)


def attribute_heads(vocabulary: AttributeVocabulary, features: int) -> nn.ModuleDict:
    """A linear layer for each attribute: logits of a category's values, or a standardised scalar."""
    sizes = {name: len(values) for name, values in vocabulary.categories.items()} | dict.fromkeys(vocabulary.scalars, 1)
    return nn.ModuleDict({name: nn.Linear(features, size) for name, size in sizes.items()})


def detail_energies(pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n d"]:
    """Logarithm of the energy of each band of detail inside each portrait's figure, away from its outline."""
    rgba = pictures.flatten(0, 1).float() / 255
    alpha = rgba[..., 3]
    image = (rgba[..., :3].mean(-1) + 0.5 * (1 - alpha))[:, None]
    energies, finer = [], image
    for sigma in BANDS:
        coarser = _blurred(image, sigma)
        reach = round(3 * sigma)
        outside = -alpha[:, None]
        for size, padding in (((1, 2 * reach + 1), (0, reach)), ((2 * reach + 1, 1), (reach, 0))):
            outside = functional.max_pool2d(outside, size, stride=1, padding=padding)
        inside = outside < -0.95
        energy = ((finer - coarser).square() * inside).sum((1, 2, 3)) / inside.sum((1, 2, 3)).clamp_min(1)
        energies.append((energy + 1e-7).log())
        finer = coarser
    return torch.stack(energies, dim=1).reshape(len(pictures), -1)


def _blurred(images: Float[Tensor, "n 1 h w"], sigma: float) -> Float[Tensor, "n 1 h w"]:
    offset = torch.arange(-round(3 * sigma), round(3 * sigma) + 1)
    kernel = torch.exp(-0.5 * (offset / sigma) ** 2)
    kernel = (kernel / kernel.sum()).reshape(1, 1, 1, -1)
    return functional.conv2d(functional.conv2d(images, kernel, padding="same"), kernel.mT, padding="same")
