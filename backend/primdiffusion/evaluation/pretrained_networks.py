"""Image networks that others trained: VGG16, VGG19, AlexNet, Inception-V3 and CLIP, with weights from local files.

Layers have the names of the published files; nothing is downloaded. docs/design/evaluation.md says why no library
supplies them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.files import tensor_file, torch_file
from primdiffusion.files.regular_files import FileError, as_file_error


@dataclasses.dataclass(frozen=True)
class Convolution:
    """A convolution followed by a ReLU."""

    channels: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1


@dataclasses.dataclass(frozen=True)
class Architecture:
    """A network as blocks of convolutions with max pooling between them."""

    name: str
    blocks: tuple[tuple[Convolution, ...], ...]
    pool: int
    """Kernel size of the pooling, whose stride is 2."""
    smallest: int
    """Smallest width and height of an input, pixels."""


def _vgg(name: str, depths: Sequence[int]) -> Architecture:
    channels = (64, 128, 256, 512, 512)
    blocks = tuple((Convolution(c),) * depth for c, depth in zip(channels, depths, strict=True))
    return Architecture(name, blocks, 2, 16)


VGG16 = _vgg("VGG16", (2, 2, 3, 3, 3))
VGG19 = _vgg("VGG19", (2, 2, 4, 4, 4))
"""Simonyan and Zisserman 2014."""
ALEXNET = Architecture(
    "AlexNet",
    (
        (Convolution(64, 11, 4, 2),),
        (Convolution(192, 5, 1, 2),),
        (Convolution(384), Convolution(256), Convolution(256)),
    ),
    3,
    31,
)
"""Krizhevsky 2014, the one-column form."""


IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
"""Mean and standard deviation of sRGB-encoded values in [0, 1], with which torchvision's networks were trained."""


class PictureFeatures(nn.Module):
    """VGG or AlexNet up to the last requested layer, frozen: gradients reach the input, not the weights.

    The layers are torchvision's `features`.
    """

    def __init__(self, architecture: Architecture, taps: Sequence[str]) -> None:
        """Build the network with random weights.

        `taps` names layers: "relu3_2" follows the second convolution of the third block. Raises ValueError for an
        unknown layer.
        """
        super().__init__()
        layers, numbers, before = [], {}, 3
        for block, convolutions in enumerate(architecture.blocks, start=1):
            if block > 1:
                layers.append(nn.MaxPool2d(architecture.pool, stride=2))
            for number, one in enumerate(convolutions, start=1):
                layers.append(nn.Conv2d(before, one.channels, one.kernel, one.stride, one.padding))
                layers.append(nn.ReLU())
                numbers[f"relu{block}_{number}"] = len(layers) - 1
                before = one.channels
        if unknown := [tap for tap in taps if tap not in numbers]:
            raise ValueError(f"{architecture.name} has no layer {unknown[0]!r}: choose from {', '.join(numbers)}")
        self.architecture = architecture
        self._taps = [numbers[tap] for tap in taps]
        self.features = nn.Sequential(*layers[: max(self._taps) + 1])
        self.requires_grad_(False).eval()

    def forward(self, pictures: Float[Tensor, "n 3 H W"]) -> list[Float[Tensor, "n c h w"]]:
        """Return the outputs of the tapped layers in order. Raises ValueError for images that are too small."""
        if min(pictures.shape[-2:]) < self.architecture.smallest:
            raise ValueError(
                f"images of {pictures.shape[-1]} x {pictures.shape[-2]} pixels are too small for "
                f"{self.architecture.name}: give at least {self.architecture.smallest} x {self.architecture.smallest}"
            )
        outputs = {}
        for number, layer in enumerate(self.features):
            pictures = layer(pictures)
            outputs[number] = pictures
        return [outputs[tap] for tap in self._taps]


def read_weights(path: Path | str) -> dict[str, Tensor]:
    """Read a state dict from a .safetensors file or a file written by torch.save, without executing pickled code.

    Raises:
        FileNotFoundError: the file does not exist.
        FileError: the file is truncated or not a dictionary of named tensors.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no weights file at {path}: check the path")
    if path.suffix == ".safetensors":
        with as_file_error(path, "is damaged or not a safetensors file", "download it again"):
            return tensor_file.read(path)[0]
    content = torch_file.load(path)
    if not isinstance(content, Mapping) or not all(
        isinstance(value, Tensor) and torch_file.is_plain(value) for value in content.values()
    ):
        raise FileError(path, "is not a dictionary of named tensors", "save the network's state_dict()")
    return dict(content)


def load_matching(network: nn.Module, weights: Mapping[str, Tensor], what: str, source: str) -> None:
    """Load the weights that `network` has; extra ones, such as a classifier's, are ignored.

    `what` and `source` name the network and the file in messages. Raises FileError if a name is missing, a shape
    differs or a value is not finite.
    """
    for name, own in network.state_dict().items():
        if name not in weights:
            raise FileError(source, f"has no {name!r}", f"give weights of {what}")
        given = weights[name]
        if given.shape != own.shape:
            shapes = f"{tuple(given.shape)}, not {tuple(own.shape)}"
            raise FileError(source, f"has {name!r} of shape {shapes}", f"give weights of {what}")
        if not torch.isfinite(given).all():
            raise FileError(source, f"has NaN or infinite values in {name!r}", "download it again")
    network.load_state_dict({name: weights[name] for name in network.state_dict()})


def resize(pictures: Float[Tensor, "n h w 3"], side: int) -> Float[Tensor, "n 3 side side"]:
    """Pictures of side x side pixels, bilinear between the two nearest pixels from the corner of each, as TensorFlow 1
    and torch-fidelity resize them."""
    x = pictures.movedim(-1, 1)
    for dimension in (2, 3):
        position = torch.arange(side, device=x.device) * (x.shape[dimension] / side)
        low = position.long()
        high = (low + 1).clamp_max(x.shape[dimension] - 1)
        share = (position - low).reshape([-1 if d == dimension else 1 for d in range(4)])
        x = x.index_select(dimension, low).lerp(x.index_select(dimension, high), share)
    return x


Size = int | tuple[int, int]
Layer = tuple[int, Size] | tuple[int, Size, Size]
"""Channels and kernel of a convolution, or of two side by side."""


class NormalisedConvolution(nn.Module):
    """Convolution without bias, batch normalisation, ReLU."""

    def __init__(self, channels: int, out: int, kernel: Size, stride: int = 1, padding: Size = 0) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(out, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.bn(self.conv(x)))


def average_pool(x: Tensor) -> Tensor:
    """3 x 3 average pooling without the padding."""
    return functional.avg_pool2d(x, 3, 1, 1, count_include_pad=False)


def max_pool(x: Tensor) -> Tensor:
    """3 x 3 max pooling, for the last block."""
    return functional.max_pool2d(x, 3, 1, 1)


class InceptionBlock(nn.Module):
    """Branches of convolutions side by side, and one of pooling."""

    def __init__(
        self,
        channels: int,
        branches: Mapping[str, Sequence[Layer]],
        pooled: int | None,
        pooling: Callable[[Tensor], Tensor] = average_pool,
    ) -> None:
        """Build it; `pooled` are the channels of the pooling branch, None in blocks that halve width and height."""
        super().__init__()
        self._branches: list[list[list[str]]] = []
        self._pooling = pooling if pooled else None
        for branch, layers in branches.items():
            names, width = [], channels
            for number, (out, *kernels) in enumerate(layers, start=1):
                name = branch if len(layers) == 1 else f"{branch}_{number}"
                names.append([name] if len(kernels) == 1 else [f"{name}a", f"{name}b"])
                halved = pooled is None and number == len(layers)
                for each, kernel in zip(names[-1], kernels, strict=True):
                    same = kernel // 2 if isinstance(kernel, int) else (kernel[0] // 2, kernel[1] // 2)
                    stride, padding = (2, 0) if halved else (1, same)
                    self.add_module(each, NormalisedConvolution(width, out, kernel, stride, padding))
                width = out
            self._branches.append(names)
        if pooled:
            self.branch_pool = NormalisedConvolution(channels, pooled, 1)

    def forward(self, x: Tensor) -> Tensor:
        outputs = []
        for branch in self._branches:
            parts = [x]
            for names in branch:  # two side by side are always the last
                parts = [self.get_submodule(name)(parts[0]) for name in names]
            outputs += parts
        outputs.append(self.branch_pool(self._pooling(x)) if self._pooling else functional.max_pool2d(x, 3, 2))
        return torch.cat(outputs, 1)


class Inception(nn.Module):
    """Inception-V3 as FID uses it, 2048 features (Szegedy et al. 2016, Heusel et al. 2017).

    Matches pt_inception-2015-12-05-6726825d.pth, the file behind published FIDs. Weights are random until
    `load_inception` fills them. Features equal torch-fidelity's on bytes.
    """

    SIDE = 299

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3, self.Conv2d_2a_3x3 = NormalisedConvolution(3, 32, 3, 2), NormalisedConvolution(32, 32, 3)
        self.Conv2d_2b_3x3 = NormalisedConvolution(32, 64, 3, padding=1)
        self.Conv2d_3b_1x1, self.Conv2d_4a_3x3 = NormalisedConvolution(64, 80, 1), NormalisedConvolution(80, 192, 3)
        across, down, double = (1, 7), (7, 1), ((64, 1), (96, 3), (96, 3))
        narrow = {"branch1x1": [(64, 1)], "branch5x5": [(48, 1), (64, 5)], "branch3x3dbl": double}
        self.Mixed_5b, self.Mixed_5c = InceptionBlock(192, narrow, 32), InceptionBlock(256, narrow, 64)
        self.Mixed_5d = InceptionBlock(288, narrow, 64)
        self.Mixed_6a = InceptionBlock(288, {"branch3x3": [(384, 3)], "branch3x3dbl": double}, None)
        for name, inner in (("6b", 128), ("6c", 160), ("6d", 160), ("6e", 192)):
            middle = {
                "branch1x1": [(192, 1)],
                "branch7x7": [(inner, 1), (inner, across), (192, down)],
                "branch7x7dbl": [(inner, 1), (inner, down), (inner, across), (inner, down), (192, across)],
            }
            self.add_module(f"Mixed_{name}", InceptionBlock(768, middle, 192))
        halving = {
            "branch3x3": [(192, 1), (320, 3)],
            "branch7x7x3": [(192, 1), (192, across), (192, down), (192, 3)],
        }
        self.Mixed_7a = InceptionBlock(768, halving, None)
        wide = {
            "branch1x1": [(320, 1)],
            "branch3x3": [(384, 1), (384, (1, 3), (3, 1))],
            "branch3x3dbl": [(448, 1), (384, 3), (384, (1, 3), (3, 1))],
        }
        self.Mixed_7b, self.Mixed_7c = InceptionBlock(1280, wide, 192), InceptionBlock(2048, wide, 192, max_pool)
        self.requires_grad_(False).eval()

    def forward(self, pictures: Float[Tensor, "n h w 3"]) -> Float[Tensor, "n 2048"]:
        """Features of sRGB-encoded pictures in [0, 1]."""
        x = (255 * resize(pictures, self.SIDE) - 128) / 128  # of bytes, as in the TensorFlow graph
        x = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(x)))
        x = self.Conv2d_4a_3x3(self.Conv2d_3b_1x1(functional.max_pool2d(x, 3, 2)))
        x = functional.max_pool2d(x, 3, 2)
        for name in ("5b", "5c", "5d", "6a", "6b", "6c", "6d", "6e", "7a", "7b", "7c"):
            x = self.get_submodule(f"Mixed_{name}")(x)
        return x.mean((2, 3))


def load_inception(path: Path | str) -> Inception:
    """Load the encoder from a weights file. Raises FileNotFoundError and FileError."""
    network = Inception()
    # Older files lack num_batches_tracked, which evaluation mode does not use.
    own = {name: value for name, value in network.state_dict().items() if name.endswith("num_batches_tracked")}
    load_matching(network, {**own, **read_weights(path)}, "Inception-V3 as FID uses it", str(path))
    return network


def quick_gelu(x: Tensor) -> Tensor:
    """x sigmoid(1.702 x), CLIP's activation."""
    return x * torch.sigmoid(1.702 * x)


class ClipVision(nn.Module):
    """CLIP's ViT-B/32, 512 features (Radford et al. 2021), for FID_CLIP (Kynkäänniemi et al. 2022).

    Weights are random until `load_clip_vision` fills them.
    """

    SIDE, PATCH, WIDTH, LAYERS, HEADS, FEATURES = 224, 32, 768, 12, 12, 512
    MEAN, STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)

    def __init__(self) -> None:
        super().__init__()
        width = self.WIDTH
        self.conv1 = nn.Conv2d(3, width, self.PATCH, self.PATCH, bias=False)
        self.class_embedding = nn.Parameter(torch.randn(width) / width**0.5)
        self.positional_embedding = nn.Parameter(torch.randn((self.SIDE // self.PATCH) ** 2 + 1, width) / width**0.5)
        self.ln_pre, self.ln_post = nn.LayerNorm(width), nn.LayerNorm(width)
        block = nn.TransformerEncoderLayer(
            width, self.HEADS, 4 * width, dropout=0, activation=quick_gelu, batch_first=True, norm_first=True
        )
        self.transformer = nn.TransformerEncoder(block, self.LAYERS, enable_nested_tensor=False)
        self.proj = nn.Parameter(torch.randn(width, self.FEATURES) / width**0.5)
        self.requires_grad_(False).eval()

    def forward(self, pictures: Float[Tensor, "n h w 3"]) -> Float[Tensor, "n 512"]:
        """Features of sRGB-encoded square pictures in [0, 1]."""
        x = resize(pictures, self.SIDE)
        mean, std = (x.new_tensor(values)[:, None, None] for values in (self.MEAN, self.STD))
        patches = self.conv1((x - mean) / std).flatten(2).mT
        first = self.class_embedding.expand(len(x), 1, -1)
        tokens = self.ln_pre(torch.cat([first, patches], dim=1) + self.positional_embedding)
        return self.ln_post(self.transformer(tokens)[:, 0]) @ self.proj


CLIP_NAMES = {
    "resblocks": "layers",
    "attn": "self_attn",
    "ln_1": "norm1",
    "ln_2": "norm2",
    "mlp.c_fc": "linear1",
    "mlp.c_proj": "linear2",
}
"""Parts of OpenAI's names of layers, and torch's."""


def load_clip_vision(path: Path | str) -> ClipVision:
    """Load the encoder from a weights file with OpenAI's names, with or without the text encoder.

    OpenAI's own file is a TorchScript program and is not run: save its state_dict() as .safetensors. Raises
    FileNotFoundError and FileError.
    """
    given = read_weights(path)
    beside_text = {name[7:]: value for name, value in given.items() if name.startswith("visual.")}
    weights = {}
    for name, value in (beside_text or given).items():
        for theirs, ours in CLIP_NAMES.items():
            name = name.replace(f".{theirs}.", f".{ours}.")
        weights[name] = value.float()
    network = ClipVision()
    load_matching(network, weights, "CLIP's ViT-B/32", str(path))
    return network
