"""A feature space for humans: the features of a small network that predicts known attributes from portraits.

Networks pretrained on photographs need weights that are not always available. This one is trained within minutes on the
diffusion model's training set; sets are compared by the features it learns to classify outfit, hair, age or pattern.
Attributes show through any blur, so the energy of fine detail in each portrait is added to the learned features.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion import tensor_file
from primdiffusion.evaluation.gallery import PORTRAITS
from primdiffusion.formats.json_files import parse_json
from primdiffusion.formats.regular_files import as_file_error
from primdiffusion.formats.whole_files import written_whole

CATEGORIES = ("sex", "age", "outfit", "pattern", "shoes", "hair", "hair_colour", "hat")
SCALARS = ("skin_tone", "height")
UNKNOWN = -100
"""Label of a value that is absent from the training set or not visible; ignored by loss and accuracy."""
FEATURES = 96
WIDTHS = (16, 32, 64, 96, 96)
POOLED = 3
"""Side of the last feature map after pooling."""
LEARNING_RATE = 2e-3
SHIFT = 8
"""Largest random shift of portraits in training, pixels."""
BANDS = (1.0, 2.0, 4.0)
"""Standard deviations, in pixels, of the Gaussians whose differences are bands of detail: finer than each."""


@dataclasses.dataclass(frozen=True)
class AttributeSpace:
    """The attributes to predict: values of each category, mean and standard deviation of each scalar."""

    categories: dict[str, tuple[str, ...]]
    scalars: dict[str, tuple[float, float]]

    @classmethod
    def from_json(cls, text: str) -> AttributeSpace:
        """Undo `to_json`. Raises KeyError, TypeError, ValueError, AttributeError."""
        stated = parse_json(text)
        return cls(
            {name: tuple(values) for name, values in stated["categories"].items()},
            {name: (mean, std) for name, (mean, std) in stated["scalars"].items()},
        )

    def to_json(self) -> str:
        """As a text for a file's metadata."""
        return json.dumps(dataclasses.asdict(self))

    def labels(self, attributes: Sequence[Mapping[str, Any]]) -> dict[str, Tensor]:
        """Class indices and standardised scalars of samples; UNKNOWN or NaN where an attribute is missing."""
        labels = {}
        for name, values in self.categories.items():
            index: dict[str | None, int] = {value: number for number, value in enumerate(values)}
            labels[name] = torch.tensor([index.get(category(sample, name), UNKNOWN) for sample in attributes])
        for name, (mean, std) in self.scalars.items():
            labels[name] = torch.tensor([(float(sample.get(name, torch.nan)) - mean) / std for sample in attributes])
        return labels


def category(sample: Mapping[str, Any], name: str) -> str | None:
    """Value of one category of a sample: the first pattern that is not plain; None for the hair colour of the bald."""
    value = sample.get(name)
    if name == "pattern" and value is not None:
        return min(set(str(value).split(", ")) - {"solid"}, default="solid")
    if name == "hair_colour" and sample.get("hair") == "none":
        return None
    return None if value is None else str(value)


def attribute_space(attributes: Sequence[Mapping[str, Any]]) -> AttributeSpace:
    """Collect the attributes of a training set; categories with a single value are left out."""
    categories = {}
    for name in CATEGORIES:
        values = {category(sample, name) for sample in attributes} - {None}
        if len(values) > 1:
            categories[name] = tuple(sorted(str(value) for value in values))
    scalars = {}
    for name in SCALARS:
        if known := [float(sample[name]) for sample in attributes if name in sample]:
            values = torch.tensor(known)
            scalars[name] = (float(values.mean()), max(float(values.std(correction=0)), 1e-6))
    return AttributeSpace(categories, scalars)


class AttributeNetwork(nn.Module):
    """Convolutions on each portrait, a linear layer on all of them (the learned features), a linear head per attribute.

    Learned features and detail have unit variance over the training set.
    """

    detail_mean: Tensor
    detail_std: Tensor

    def __init__(self, space: AttributeSpace):
        super().__init__()
        self.space = space
        layers, before = [], 4
        for width in WIDTHS:
            layers += [nn.Conv2d(before, width, 3, stride=2, padding=1), nn.BatchNorm2d(width), nn.ReLU()]
            before = width
        self.trunk = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(POOLED))
        # Batch normalisation gives each feature unit variance over the training set: the unit of distances.
        self.features = nn.Sequential(
            nn.Dropout(0.2),
            nn.Linear(len(PORTRAITS) * before * POOLED**2, FEATURES),
            nn.BatchNorm1d(FEATURES, affine=False),
        )
        sizes = {name: len(values) for name, values in space.categories.items()} | dict.fromkeys(space.scalars, 1)
        self.heads = nn.ModuleDict({name: nn.Linear(FEATURES, size) for name, size in sizes.items()})
        self.register_buffer("detail_mean", torch.zeros(len(PORTRAITS) * len(BANDS)))
        self.register_buffer("detail_std", torch.ones(len(PORTRAITS) * len(BANDS)))

    def forward(self, pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n f"]:
        """Features of portraits: the learned ones, then detail."""
        detail = (detail_energies(pictures) - self.detail_mean) / self.detail_std
        return torch.cat([self.learned(pictures), detail], dim=1)

    def learned(self, pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n 96"]:
        """Learned features of portraits."""
        values = pictures.movedim(-1, -3).flatten(0, 1).float() / 255 - 0.25
        return self.features(self.trunk(values).unflatten(0, pictures.shape[:2]).flatten(1))

    def predict(self, features: Float[Tensor, "n f"]) -> dict[str, Tensor]:
        """Logits of each category and standardised scalars, from the learned features."""
        active = functional.relu(features[:, :FEATURES])
        return {name: head(active) for name, head in self.heads.items()}


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


def features_of(network: AttributeNetwork, pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n f"]:
    """Features of any number of samples, computed in batches without gradients."""
    with torch.inference_mode():
        return torch.cat([network(part) for part in pictures.split(64)]).clone()


def fit_attribute_network(
    pictures: UInt8[Tensor, "n v h w 4"],
    attributes: Sequence[Mapping[str, Any]],
    *,
    epochs: int = 20,
    batch: int = 64,
    report: Callable[[int, float], None] = lambda epoch, loss: None,
) -> AttributeNetwork:
    """Train a network; `report` receives each epoch and its mean loss. Deterministic on a device."""
    space = attribute_space(attributes)
    labels = space.labels(attributes)
    generator = torch.Generator().manual_seed(0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = AttributeNetwork(space)
        optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=0.05)
        steps = epochs * -(-len(attributes) // batch)
        scheduler = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=steps + 1, pct_start=0.1)
        for epoch in range(epochs):
            losses = []
            for chosen in torch.randperm(len(attributes), generator=generator).split(batch):
                predicted = network.predict(network.learned(_shifted(pictures[chosen], generator)))
                loss = attribute_loss(predicted, {name: values[chosen] for name, values in labels.items()}, space)
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                scheduler.step()
                losses.append(float(loss.detach()))
            report(epoch + 1, sum(losses) / len(losses))
    detail = torch.cat([detail_energies(part) for part in pictures.split(64)])
    network.detail_mean, network.detail_std = detail.mean(0), detail.std(0, correction=0).clamp_min(0.05)
    return network.eval().requires_grad_(False)


def _shifted(pictures: Tensor, generator: torch.Generator) -> Tensor:
    """The batch shifted by one random offset, padded with empty pixels."""
    right, down = (torch.randint(-SHIFT, SHIFT + 1, (2,), generator=generator)).tolist()
    padded = functional.pad(pictures, (0, 0, SHIFT, SHIFT, SHIFT, SHIFT))
    height, width = pictures.shape[2:4]
    return padded[:, :, SHIFT - down : SHIFT - down + height, SHIFT - right : SHIFT - right + width]


def attribute_loss(predicted: Mapping[str, Tensor], labels: Mapping[str, Tensor], space: AttributeSpace) -> Tensor:
    """Cross entropy of categories plus squared error of scalars, over the labels that are known."""
    total = torch.zeros(())
    for name in space.categories:
        known = labels[name] != UNKNOWN
        if known.any():
            total = total + functional.cross_entropy(predicted[name][known], labels[name][known])
    for name in space.scalars:
        known = labels[name].isfinite()
        if known.any():
            total = total + (predicted[name][known, 0] - labels[name][known]).square().mean()
    return total


def accuracies(
    network: AttributeNetwork, features: Float[Tensor, "n f"], attributes: Sequence[Mapping[str, Any]]
) -> dict[str, float]:
    """Accuracy for each category, R^2 about the training mean for each scalar."""
    labels = network.space.labels(attributes)
    with torch.inference_mode():
        predicted = network.predict(features)
    result = {}
    for name in network.space.categories:
        known = labels[name] != UNKNOWN
        result[name] = float((predicted[name].argmax(-1) == labels[name])[known].double().mean())
    for name in network.space.scalars:
        error = (predicted[name][:, 0] - labels[name]).square().mean()
        result[name] = float(1 - error / labels[name].square().mean())
    return result


def save_attribute_network(path: Path, network: AttributeNetwork) -> None:
    """Write the network in half precision, atomically."""
    halved = {k for k, v in network.state_dict().items() if v.is_floating_point() and not k.startswith("detail_")}
    tensors = {k: v.half() if k in halved else v for k, v in network.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        unfinished.write_bytes(tensor_file.save(tensors, metadata={"answers": network.space.to_json()}))


def load_attribute_network(path: Path) -> AttributeNetwork:
    """Load what `save_attribute_network` wrote. Raises FileNotFoundError, and ValueError for an unreadable file."""
    if not path.is_file():
        raise FileNotFoundError(f"no feature network at {path}: choose a folder to train one in")
    reason = "is not a feature network of this version"
    with as_file_error(path, reason, "delete it to train a new one", OSError, RuntimeError):
        tensors, metadata = tensor_file.read(path)
        space = AttributeSpace.from_json(metadata["answers"])
        network = tensor_file.load_network(lambda: AttributeNetwork(space), tensors)
    return network.eval().requires_grad_(False)
