"""A feature space for people: a small network that tells their known attributes from portraits.

Networks that others trained on photographs are not at hand everywhere. This one is trained in minutes on the people a
diffusion model is trained on; what it needs to tell outfits, hair, age or patterns apart is what sets are compared by.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.evaluation.portraits import PORTRAITS
from primdiffusion.staging import written_whole

CATEGORIES = ("sex", "age", "outfit", "pattern", "shoes", "hair", "hair_colour", "hat")
SCALARS = ("skin_tone", "height")
UNKNOWN = -100
"""Label of a value that no training person has, or that cannot be seen; counts for nothing."""
FEATURES = 96
WIDTHS = (16, 32, 64, 96)
POOLED = 3
"""Places a side of the last picture."""
SHIFT = 3
"""Pixels by which portraits are moved at random in training."""


@dataclasses.dataclass(frozen=True)
class Answers:
    """What can be told of people: values of each category, mean and standard deviation of each scalar."""

    categories: dict[str, tuple[str, ...]]
    scalars: dict[str, tuple[float, float]]

    def labels(self, people: Sequence[Mapping[str, Any]]) -> dict[str, Tensor]:
        """Numbers of the values, standardised scalars; UNKNOWN and NaN where a person's is not known."""
        labels = {}
        for name, values in self.categories.items():
            of: dict[str | None, int] = {value: number for number, value in enumerate(values)}
            labels[name] = torch.tensor([of.get(category(person, name), UNKNOWN) for person in people])
        for name, (mean, std) in self.scalars.items():
            labels[name] = torch.tensor([(float(person.get(name, torch.nan)) - mean) / std for person in people])
        return labels


def category(person: Mapping[str, Any], name: str) -> str | None:
    """A person's value; of patterns the first that is not plain; None for the hair colour of the bald."""
    value = person.get(name)
    if name == "pattern" and value is not None:
        return min(set(str(value).split(", ")) - {"solid"}, default="solid")
    if name == "hair_colour" and person.get("hair") == "none":
        return None
    return None if value is None else str(value)


def answers_of(people: Sequence[Mapping[str, Any]]) -> Answers:
    """All that is known of these people."""
    categories = {}
    for name in CATEGORIES:
        values = {category(person, name) for person in people} - {None}
        if len(values) > 1:
            categories[name] = tuple(sorted(str(value) for value in values))
    scalars = {}
    for name in SCALARS:
        if known := [float(person[name]) for person in people if name in person]:
            values = torch.tensor(known)
            scalars[name] = (float(values.mean()), max(float(values.std(correction=0)), 1e-6))
    return Answers(categories, scalars)


class AttributeNetwork(nn.Module):
    """Four convolutions on each portrait, one linear layer on all: the features; a linear layer for each answer."""

    def __init__(self, answers: Answers):
        super().__init__()
        self.answers = answers
        layers, before = [], 4
        for width in WIDTHS:
            layers += [nn.Conv2d(before, width, 3, stride=2, padding=1), nn.BatchNorm2d(width), nn.ReLU()]
            before = width
        self.trunk = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(POOLED))
        # Normalised: every feature varies by 1 over the training people, so distances are in such units.
        self.features = nn.Sequential(
            nn.Dropout(0.2),
            nn.Linear(len(PORTRAITS) * before * POOLED**2, FEATURES),
            nn.BatchNorm1d(FEATURES, affine=False),
        )
        sizes = {name: len(values) for name, values in answers.categories.items()} | dict.fromkeys(answers.scalars, 1)
        self.heads = nn.ModuleDict({name: nn.Linear(FEATURES, size) for name, size in sizes.items()})

    def forward(self, pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n 96"]:
        """Features of portraits."""
        values = pictures.movedim(-1, -3).flatten(0, 1).float() / 255 - 0.25
        return self.features(self.trunk(values).unflatten(0, pictures.shape[:2]).flatten(1))

    def told(self, features: Float[Tensor, "n 96"]) -> dict[str, Tensor]:
        """Scores of each category's values, and standardised scalars."""
        shown = functional.relu(features)
        return {name: head(shown) for name, head in self.heads.items()}


def features_of(network: AttributeNetwork, pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n 96"]:
    """Of any number of people, in evaluation mode."""
    with torch.inference_mode():
        return torch.cat([network(part) for part in pictures.split(64)]).clone()


def fit_attribute_network(
    pictures: UInt8[Tensor, "n v h w 4"],
    people: Sequence[Mapping[str, Any]],
    *,
    epochs: int = 20,
    batch: int = 64,
    learning_rate: float = 2e-3,
    seed: int = 0,
    report: Callable[[int, float], None] = lambda epoch, loss: None,
) -> AttributeNetwork:
    """Trained on these people; `report` is told of each epoch's mean loss. Deterministic for a seed and device."""
    answers = answers_of(people)
    labels = answers.labels(people)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = AttributeNetwork(answers)
        optimiser = torch.optim.AdamW(network.parameters(), lr=learning_rate, weight_decay=0.05)
        steps = epochs * -(-len(people) // batch)
        falling = torch.optim.lr_scheduler.OneCycleLR(optimiser, learning_rate, total_steps=steps + 1, pct_start=0.1)
        for epoch in range(epochs):
            losses = []
            for chosen in torch.randperm(len(people), generator=generator).split(batch):
                moved = _moved(pictures[chosen], generator)
                told = network.told(network(moved))
                loss = _loss(told, {name: values[chosen] for name, values in labels.items()}, answers)
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                falling.step()
                losses.append(float(loss.detach()))
            report(epoch + 1, sum(losses) / len(losses))
    return network.eval().requires_grad_(False)


def _moved(pictures: Tensor, generator: torch.Generator) -> Tensor:
    """A batch moved by a few pixels, all alike; what enters is empty."""
    right, down = (torch.randint(-SHIFT, SHIFT + 1, (2,), generator=generator)).tolist()
    padded = functional.pad(pictures, (0, 0, SHIFT, SHIFT, SHIFT, SHIFT))
    height, width = pictures.shape[2:4]
    return padded[:, :, SHIFT - down : SHIFT - down + height, SHIFT - right : SHIFT - right + width]


def _loss(told: Mapping[str, Tensor], labels: Mapping[str, Tensor], answers: Answers) -> Tensor:
    total = torch.zeros(())
    for name in answers.categories:
        known = labels[name] != UNKNOWN
        if known.any():
            total = total + functional.cross_entropy(told[name][known], labels[name][known])
    for name in answers.scalars:
        known = labels[name].isfinite()
        if known.any():
            total = total + (told[name][known, 0] - labels[name][known]).square().mean()
    return total


def accuracies(
    network: AttributeNetwork, features: Float[Tensor, "n 96"], people: Sequence[Mapping[str, Any]]
) -> dict[str, float]:
    """Share of people whose value is told; of scalars the share of variance about the training mean, R^2."""
    labels = network.answers.labels(people)
    with torch.inference_mode():
        told = network.told(features)
    result = {}
    for name in network.answers.categories:
        known = labels[name] != UNKNOWN
        result[name] = float((told[name].argmax(-1) == labels[name])[known].double().mean())
    for name in network.answers.scalars:
        error = (told[name][:, 0] - labels[name]).square().mean()
        result[name] = float(1 - error / labels[name].square().mean())
    return result


def save_attribute_network(path: Path, network: AttributeNetwork) -> None:
    """Writes it in half precision, whole or not at all."""
    tensors = {k: v.half() if v.is_floating_point() else v for k, v in network.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        unfinished.write_bytes(save(tensors, metadata={"answers": json.dumps(dataclasses.asdict(network.answers))}))


def load_attribute_network(path: Path) -> AttributeNetwork:
    """What `save_attribute_network` wrote. Raises FileNotFoundError, and ValueError for another file."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no feature network {path}: name a folder that one can be trained into")
    try:
        with safe_open(path, framework="pt") as file:
            stated = json.loads(file.metadata()["answers"])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - safe_open is no mapping
        answers = Answers(
            {name: tuple(values) for name, values in stated["categories"].items()},
            {name: (mean, std) for name, (mean, std) in stated["scalars"].items()},
        )
        network = AttributeNetwork(answers)
        network.load_state_dict(tensors)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(
            f"{path} is no feature network of this version ({reason}): remove it, to train it again"
        ) from error
    return network.eval().requires_grad_(False)
