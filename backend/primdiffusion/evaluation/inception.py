"""Inception-V3 as FID uses it (Szegedy et al. 2016, Heusel et al. 2017), with weights from a local file.

Layers have torchvision's names and match pt_inception-2015-12-05-6726825d.pth, the file behind published FIDs; nothing
is downloaded. As in that network, average pooling excludes the padding, and the last block uses max pooling.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.picture_features import fill, read_weights

SIDE = 299
FEATURES = 2048
Size = int | tuple[int, int]


class Convolution(nn.Module):
    """Convolution without bias, batch normalisation, ReLU."""

    def __init__(self, channels: int, out: int, kernel: Size, stride: int = 1, padding: Size = 0) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(out, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        """Apply convolution, normalisation and ReLU."""
        return functional.relu(self.bn(self.conv(x)))


def across(channels: int, out: int, length: int) -> Convolution:
    """1 x `length` convolution."""
    return Convolution(channels, out, (1, length), padding=(0, length // 2))


def down(channels: int, out: int, length: int) -> Convolution:
    """`length` x 1 convolution."""
    return Convolution(channels, out, (length, 1), padding=(length // 2, 0))


def chain(module: nn.Module, x: Tensor, *names: str) -> Tensor:
    """Apply the named layers of a module in sequence."""
    for name in names:
        x = module.get_submodule(name)(x)
    return x


def averaged(x: Tensor) -> Tensor:
    """3 x 3 average pooling without the padding."""
    return functional.avg_pool2d(x, 3, 1, 1, count_include_pad=False)


class BlockA(nn.Module):
    """Block on 35 x 35 feature maps."""

    def __init__(self, channels: int, pooled: int) -> None:
        super().__init__()
        self.branch1x1 = Convolution(channels, 64, 1)
        self.branch5x5_1, self.branch5x5_2 = Convolution(channels, 48, 1), Convolution(48, 64, 5, padding=2)
        self.branch3x3dbl_1, self.branch3x3dbl_2 = Convolution(channels, 64, 1), Convolution(64, 96, 3, padding=1)
        self.branch3x3dbl_3, self.branch_pool = Convolution(96, 96, 3, padding=1), Convolution(channels, pooled, 1)

    def forward(self, x: Tensor) -> Tensor:
        """All branches side by side."""
        double = chain(self, x, "branch3x3dbl_1", "branch3x3dbl_2", "branch3x3dbl_3")
        return torch.cat(
            [self.branch1x1(x), chain(self, x, "branch5x5_1", "branch5x5_2"), double, self.branch_pool(averaged(x))], 1
        )


class BlockB(nn.Module):
    """Block from 35 x 35 to 17 x 17 feature maps."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.branch3x3 = Convolution(channels, 384, 3, 2)
        self.branch3x3dbl_1, self.branch3x3dbl_2 = Convolution(channels, 64, 1), Convolution(64, 96, 3, padding=1)
        self.branch3x3dbl_3 = Convolution(96, 96, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        """All branches side by side."""
        double = chain(self, x, "branch3x3dbl_1", "branch3x3dbl_2", "branch3x3dbl_3")
        return torch.cat([self.branch3x3(x), double, functional.max_pool2d(x, 3, 2)], 1)


class BlockC(nn.Module):
    """Block on 17 x 17 feature maps."""

    def __init__(self, channels: int, inner: int) -> None:
        super().__init__()
        self.branch1x1, self.branch_pool = Convolution(channels, 192, 1), Convolution(channels, 192, 1)
        self.branch7x7_1, self.branch7x7_2 = Convolution(channels, inner, 1), across(inner, inner, 7)
        self.branch7x7_3 = down(inner, 192, 7)
        self.branch7x7dbl_1, self.branch7x7dbl_2 = Convolution(channels, inner, 1), down(inner, inner, 7)
        self.branch7x7dbl_3, self.branch7x7dbl_4 = (
            across(inner, inner, 7),
            down(inner, inner, 7),
        )
        self.branch7x7dbl_5 = across(inner, 192, 7)

    def forward(self, x: Tensor) -> Tensor:
        """All branches side by side."""
        single = chain(self, x, *(f"branch7x7_{number}" for number in range(1, 4)))
        double = chain(self, x, *(f"branch7x7dbl_{number}" for number in range(1, 6)))
        return torch.cat([self.branch1x1(x), single, double, self.branch_pool(averaged(x))], 1)


class BlockD(nn.Module):
    """Block from 17 x 17 to 8 x 8 feature maps."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.branch3x3_1, self.branch3x3_2 = Convolution(channels, 192, 1), Convolution(192, 320, 3, 2)
        self.branch7x7x3_1 = Convolution(channels, 192, 1)
        self.branch7x7x3_2 = across(192, 192, 7)
        self.branch7x7x3_3 = down(192, 192, 7)
        self.branch7x7x3_4 = Convolution(192, 192, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        """All branches side by side."""
        wide = chain(self, x, *(f"branch7x7x3_{number}" for number in range(1, 5)))
        return torch.cat([chain(self, x, "branch3x3_1", "branch3x3_2"), wide, functional.max_pool2d(x, 3, 2)], 1)


class BlockE(nn.Module):
    """Block on 8 x 8 feature maps."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.branch1x1, self.branch_pool = Convolution(channels, 320, 1), Convolution(channels, 192, 1)
        self.branch3x3_1 = Convolution(channels, 384, 1)
        self.branch3x3_2a, self.branch3x3_2b = across(384, 384, 3), down(384, 384, 3)
        self.branch3x3dbl_1, self.branch3x3dbl_2 = Convolution(channels, 448, 1), Convolution(448, 384, 3, padding=1)
        self.branch3x3dbl_3a, self.branch3x3dbl_3b = across(384, 384, 3), down(384, 384, 3)

    def forward(self, x: Tensor) -> Tensor:
        """All branches side by side."""
        single, double = self.branch3x3_1(x), chain(self, x, "branch3x3dbl_1", "branch3x3dbl_2")
        single = [self.branch3x3_2a(single), self.branch3x3_2b(single)]
        double = [self.branch3x3dbl_3a(double), self.branch3x3dbl_3b(double)]
        return torch.cat([self.branch1x1(x), *single, *double, self.branch_pool(self.pooled(x))], 1)

    def pooled(self, x: Tensor) -> Tensor:
        """Input of the pooling branch."""
        return averaged(x)


class LastBlock(BlockE):
    """The last block, with max pooling instead of average pooling."""

    def pooled(self, x: Tensor) -> Tensor:
        return functional.max_pool2d(x, 3, 1, 1)


class Inception(nn.Module):
    """Image encoder with 2048 features. Weights are random until `load_inception` fills them."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3, self.Conv2d_2a_3x3 = Convolution(3, 32, 3, 2), Convolution(32, 32, 3)
        self.Conv2d_2b_3x3 = Convolution(32, 64, 3, padding=1)
        self.Conv2d_3b_1x1, self.Conv2d_4a_3x3 = Convolution(64, 80, 1), Convolution(80, 192, 3)
        self.Mixed_5b, self.Mixed_5c, self.Mixed_5d = BlockA(192, 32), BlockA(256, 64), BlockA(288, 64)
        self.Mixed_6a = BlockB(288)
        self.Mixed_6b, self.Mixed_6c = BlockC(768, 128), BlockC(768, 160)
        self.Mixed_6d, self.Mixed_6e = BlockC(768, 160), BlockC(768, 192)
        self.Mixed_7a, self.Mixed_7b, self.Mixed_7c = BlockD(768), BlockE(1280), LastBlock(2048)
        self.requires_grad_(False).eval()

    def forward(self, pictures: Float[Tensor, "n h w 3"]) -> Float[Tensor, "n 2048"]:
        """Features of sRGB-encoded pictures in [0, 1]."""
        x = functional.interpolate(pictures.movedim(-1, 1), (SIDE, SIDE), mode="bilinear", align_corners=False)
        x = chain(self, 2 * x - 1, "Conv2d_1a_3x3", "Conv2d_2a_3x3", "Conv2d_2b_3x3")
        x = chain(self, functional.max_pool2d(x, 3, 2), "Conv2d_3b_1x1", "Conv2d_4a_3x3")
        x = chain(self, functional.max_pool2d(x, 3, 2), *(f"Mixed_{block}" for block in ("5b", "5c", "5d")))
        x = chain(self, x, *(f"Mixed_{block}" for block in ("6a", "6b", "6c", "6d", "6e", "7a", "7b", "7c")))
        return x.mean((2, 3))


def load_inception(path: Path | str) -> Inception:
    """Load the encoder from a weights file. Raises FileNotFoundError and WeightsFileError."""
    network = Inception()
    weights = read_weights(path)
    # Older files lack num_batches_tracked, which evaluation mode does not use.
    own = {name: value for name, value in network.state_dict().items() if name.endswith("num_batches_tracked")}
    fill(network, {**own, **weights}, "Inception-V3 as FID uses it", str(path))
    return network
