"""Image features of pretrained VGG16, VGG19 and AlexNet, with weights from local files.

The layers are torchvision's `features` under torchvision's names, so its files load; nothing is downloaded.
"""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn


class WeightsFileError(ValueError):
    """A weights file that is damaged or of another network."""


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


class PictureFeatures(nn.Module):
    """The network up to its last requested layer, frozen: gradients reach the input, not the weights."""

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
        WeightsFileError: the file is truncated or not a dictionary of named tensors.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no weights file at {path}: check the path")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, SafetensorError, RuntimeError, EOFError, ValueError, LookupError) as e:
        raise WeightsFileError(
            f"{path} is truncated or not a plain weights file ({_reason(e)}): download it again, or save "
            "the network's state_dict()"
        ) from e
    if not isinstance(content, Mapping) or not all(isinstance(value, Tensor) for value in content.values()):
        raise WeightsFileError(f"{path} is not a dictionary of named tensors: save the network's state_dict()")
    return dict(content)


def _reason(error: Exception) -> str:
    """First sentence of the message; torch's messages continue with advice to unpickle."""
    return next(iter(str(error).split(". ")[0].splitlines()), type(error).__name__)


def fill(network: nn.Module, weights: Mapping[str, Tensor], what: str, source: str) -> None:
    """Load the weights that `network` has; extra ones, such as a classifier's, are ignored.

    `what` and `source` name the network and the file in messages. Raises WeightsFileError if a name is missing, a shape
    differs or a value is not finite.
    """
    for name, own in network.state_dict().items():
        if name not in weights:
            raise WeightsFileError(f"{source} has no {name!r}: give weights of {what}")
        given = weights[name]
        if given.shape != own.shape:
            raise WeightsFileError(
                f"{name!r} in {source} has shape {tuple(given.shape)}, not {tuple(own.shape)}: give weights of {what}"
            )
        if not torch.isfinite(given).all():
            raise WeightsFileError(f"{name!r} in {source} has NaN or infinite values: download it again")
    network.load_state_dict({name: weights[name] for name in network.state_dict()})
