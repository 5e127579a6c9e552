"""Features of pictures by networks that others trained: VGG16, VGG19 and AlexNet, from weights files that a user has.

The layers are torchvision's `features`, under torchvision's names, so its files fit; nothing is downloaded.
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
    """A file of weights that cannot be used; the message says which, why and what to do."""


@dataclasses.dataclass(frozen=True)
class Convolution:
    """One layer, a ReLU behind it."""

    channels: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1


@dataclasses.dataclass(frozen=True)
class Architecture:
    """A network as blocks of convolutions; the largest of each square of pixels is kept between blocks."""

    name: str
    blocks: tuple[tuple[Convolution, ...], ...]
    pool: int
    """Side of that square; squares are 2 pixels apart."""
    smallest: int
    """Pixels a side of the least picture that reaches the last block."""


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
    """The network up to the last layer asked for, frozen: gradients reach the picture, not the weights."""

    def __init__(self, architecture: Architecture, taps: Sequence[str]) -> None:
        """`taps` are names as "relu3_2": the second convolution of the third block. Weights are random.

        Raises ValueError for a layer that the network does not have.
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
        """The layers asked for, in that order.

        Raises ValueError for pictures too small for the network.
        """
        if min(pictures.shape[-2:]) < self.architecture.smallest:
            raise ValueError(
                f"pictures of {pictures.shape[-1]} x {pictures.shape[-2]} pixels are too small for "
                f"{self.architecture.name}: give at least {self.architecture.smallest} a side"
            )
        seen = {}
        for number, layer in enumerate(self.features):
            pictures = layer(pictures)
            seen[number] = pictures
        return [seen[tap] for tap in self._taps]


def read_weights(path: Path | str) -> dict[str, Tensor]:
    """The tensors of a .safetensors file or of one that torch.save wrote; nothing in it is run.

    Raises:
        FileNotFoundError: there is none.
        WeightsFileError: it is truncated, or holds anything else than tensors by name.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file of weights {path}: check the path")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        held = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, SafetensorError, RuntimeError, EOFError, ValueError, LookupError) as e:
        raise WeightsFileError(
            f"{path} is truncated or no plain file of weights ({_reason(e)}): download it again, or save "
            "the network's state_dict()"
        ) from e
    if not isinstance(held, Mapping) or not all(isinstance(value, Tensor) for value in held.values()):
        raise WeightsFileError(f"{path} holds something else than tensors by name: save the network's state_dict()")
    return dict(held)


def _reason(error: Exception) -> str:
    """The first sentence; torch's go on with advice to unpickle."""
    return next(iter(str(error).split(". ")[0].splitlines()), type(error).__name__)


def fill(network: nn.Module, weights: Mapping[str, Tensor], what: str, source: str) -> None:
    """Copies the weights of `network`'s names; others of the file, such as a classifier's, are left.

    Raises WeightsFileError, which says that `source` is no file of `what`, where a name is missing, a shape differs or
    a value is not finite.
    """
    for name, own in network.state_dict().items():
        if name not in weights:
            raise WeightsFileError(f"{source} has no {name!r}: give a file of {what}")
        given = weights[name]
        if given.shape != own.shape:
            raise WeightsFileError(
                f"{source} has {name!r} of shape {tuple(given.shape)}, not {tuple(own.shape)}: give a file of {what}"
            )
        if not torch.isfinite(given).all():
            raise WeightsFileError(f"{source} has NaN or infinite values in {name!r}: download it again")
    network.load_state_dict({name: weights[name] for name in network.state_dict()})
