"""Train the network of scripts/feature_space on the people that a model was trained on.

    python -m scripts.train_attribute_network --reference DIR --people DIR [--assets DIR]
    python -m scripts.train_attribute_network --reference DIR --assets DIR --meshes 160

Portraits are of the payloads in --people; with --assets, of the meshes they were made from; without --people, of
consecutive seeds. They are kept in the folder --reference, beside the network. Takes minutes. The card in the file
states how well attributes of held-out people are read.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import tyro
from jaxtyping import Float, UInt8
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.evaluation.pose_depth_network import detail_energies
from primdiffusion.files import tensor_file
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.people.assets import open_assets
from torch import Tensor, nn
from torch.nn import functional

from scripts.feature_space.comparison import NETWORK_FILE, PORTRAITS_FOLDER, real_sources
from scripts.feature_space.network import FEATURES, AttributeNetwork, features_of, load_attribute_network
from scripts.feature_space.portraits import COLOURINGS, PORTRAITS, Report, Source, mesh_sources, open_gallery, silent

CATEGORIES = ("sex", "age", "outfit", "pattern", "shoes", "hair", "hair_colour", "hat")
SCALARS = ("skin_tone", "height")
UNKNOWN = -100
"""Label of a value that is absent from the training set or not visible; ignored by loss and accuracy."""
LEARNING_RATE = 2e-3
SHIFT = 8
"""Largest random shift of portraits, pixels."""
FIRST_TRAINED, FIRST_HELD = 0, 10_000_000
"""First seeds of meshes without --people."""


def category(sample: Mapping[str, Any], name: str) -> str | None:
    """Value of one category of a sample: the first pattern that is not plain; None for the hair colour of the bald."""
    value = sample.get(name)
    if name == "pattern" and value is not None:
        return min(set(str(value).split(", ")) - {"solid"}, default="solid")
    if name == "hair_colour" and sample.get("hair") == "none":
        return None
    return None if value is None else str(value)


def visible_vocabulary(attributes: Sequence[Mapping[str, Any]]) -> AttributeVocabulary:
    """The attributes of a training set that portraits show; categories with a single value are left out."""
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
    return AttributeVocabulary(categories, scalars)


def labels_of(vocabulary: AttributeVocabulary, attributes: Sequence[Mapping[str, Any]]) -> dict[str, Tensor]:
    """Class indices and standardised scalars of samples; UNKNOWN or NaN where an attribute is missing."""
    labels = {}
    for name, values in vocabulary.categories.items():
        index: dict[str | None, int] = {value: number for number, value in enumerate(values)}
        labels[name] = torch.tensor([index.get(category(sample, name), UNKNOWN) for sample in attributes])
    for name, (mean, std) in vocabulary.scalars.items():
        labels[name] = torch.tensor([(float(sample.get(name, torch.nan)) - mean) / std for sample in attributes])
    return labels


def predicted_attributes(heads: nn.ModuleDict, features: Float[Tensor, "n f"]) -> dict[str, Tensor]:
    """Logits of each category and standardised scalars, from learned features."""
    active = functional.relu(features)
    return {name: head(active) for name, head in heads.items()}


def attribute_loss(
    predicted: Mapping[str, Tensor], labels: Mapping[str, Tensor], vocabulary: AttributeVocabulary
) -> Tensor:
    """Cross entropy of categories plus squared error of scalars, over the labels that are known."""
    total = torch.zeros(())
    for name in vocabulary.categories:
        known = labels[name] != UNKNOWN
        if known.any():
            total = total + functional.cross_entropy(predicted[name][known], labels[name][known])
    for name in vocabulary.scalars:
        known = labels[name].isfinite()
        if known.any():
            total = total + (predicted[name][known, 0] - labels[name][known]).square().mean()
    return total


def fit_attribute_network(
    pictures: UInt8[Tensor, "n v h w 4"],
    attributes: Sequence[Mapping[str, Any]],
    *,
    epochs: int = 20,
    batch: int = 64,
    report: Callable[[int, float], None] = lambda epoch, loss: None,
) -> AttributeNetwork:
    """Train a network; `report` receives each epoch and its mean loss. Deterministic on a device."""
    vocabulary = visible_vocabulary(attributes)
    labels = labels_of(vocabulary, attributes)
    generator = torch.Generator().manual_seed(0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = AttributeNetwork(vocabulary)
        optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=0.05)
        steps = epochs * -(-len(attributes) // batch)
        scheduler = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=steps + 1, pct_start=0.1)
        for epoch in range(epochs):
            losses = []
            for chosen in torch.randperm(len(attributes), generator=generator).split(batch):
                learned = network.learned(shifted(pictures[chosen], generator))
                own = {name: values[chosen] for name, values in labels.items()}
                loss = attribute_loss(predicted_attributes(network.heads, learned), own, vocabulary)
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                scheduler.step()
                losses.append(float(loss.detach()))
            report(epoch + 1, sum(losses) / len(losses))
    detail = torch.cat([detail_energies(part) for part in pictures.split(64)])
    network.detail_mean, network.detail_std = detail.mean(0), detail.std(0, correction=0).clamp_min(0.05)
    return network.eval().requires_grad_(False)


def shifted(pictures: Tensor, generator: torch.Generator) -> Tensor:
    """The batch shifted by one random offset, padded with empty pixels."""
    right, down = (torch.randint(-SHIFT, SHIFT + 1, (2,), generator=generator)).tolist()
    padded = functional.pad(pictures, (0, 0, SHIFT, SHIFT, SHIFT, SHIFT))
    height, width = pictures.shape[2:4]
    return padded[:, :, SHIFT - down : SHIFT - down + height, SHIFT - right : SHIFT - right + width]


def accuracies(
    network: AttributeNetwork, features: Float[Tensor, "n f"], attributes: Sequence[Mapping[str, Any]]
) -> dict[str, float]:
    """Accuracy for each category, R^2 about the training mean for each scalar."""
    labels = labels_of(network.vocabulary, attributes)
    with torch.inference_mode():
        predicted = predicted_attributes(network.heads, features[:, :FEATURES])
    result = {}
    for name in network.vocabulary.categories:
        known = labels[name] != UNKNOWN
        result[name] = float((predicted[name].argmax(-1) == labels[name])[known].double().mean())
    for name in network.vocabulary.scalars:
        error = (predicted[name][:, 0] - labels[name]).square().mean()
        result[name] = float(1 - error / labels[name].square().mean())
    return result


def save_attribute_network(path: Path, network: AttributeNetwork) -> None:
    """Write the network in half precision with its card, atomically."""
    halved = {k for k, v in network.state_dict().items() if v.is_floating_point() and not k.startswith("detail_")}
    tensors = {k: v.half() if k in halved else v for k, v in network.state_dict().items()}
    metadata = {"answers": json.dumps(network.vocabulary.to_json()), "card": json.dumps(network.card)}
    write_atomically(path, tensor_file.save(tensors, metadata=metadata))


def train_reference(
    train: Sequence[Source],
    held: Sequence[Source],
    folder: Path,
    only: Sequence[str] = (),
    report: Report = silent,
    report_epoch: Callable[[int, float], None] = lambda epoch, loss: None,
) -> Path:
    """Train on portraits of `train`, state accuracies on `held`, and write the network into the folder.

    `only` names portraits that take the place of all; empty: all as they are.
    """
    seen = [next(number for number, one in enumerate(PORTRAITS) if one.name == name) for name in only]
    views = seen * (len(PORTRAITS) // len(seen)) if seen else list(range(len(PORTRAITS)))
    drawn, others = (open_gallery(sources, folder / PORTRAITS_FOLDER, report) for sources in (train, held))
    network = fit_attribute_network(drawn.pictures[:, views], drawn.attributes, report=report_epoch)
    path = folder / ("_".join([NETWORK_FILE.removesuffix(".safetensors"), *only]) + ".safetensors")
    network.card = {"trained_on": len(drawn.pictures), "held_out": len(others.pictures)}
    save_attribute_network(path, network)
    network = load_attribute_network(path)  # in the precision of the file
    features = features_of(network, others.pictures[:, views])
    network.card["accuracy"] = accuracies(network, features, others.attributes)
    save_attribute_network(path, network)
    return path


@dataclasses.dataclass(frozen=True)
class Training:
    reference: Path
    """Folder for portraits and the network."""
    people: Path | None = None
    """Folder of the payloads that a model was trained on, those held out among them."""
    assets: Path | None = None
    """MakeHuman's assets: portraits of meshes instead of payloads."""
    meshes: int = 160
    """Number of meshes to train on without --people; half as many are held out."""
    holdout: float = 0.05
    """Share of --people that was held out in training."""
    seed: int = 0
    """Seed of the training run."""
    only: tuple[str, ...] = ()
    """Portraits that take the place of all: front, back, left, head."""

    def run(self) -> None:
        if self.people is not None:
            train, held = real_sources(self.people, self.assets, self.holdout, self.seed)
        else:
            assets = open_assets(self.assets)
            train, held = (
                mesh_sources(assets, range(first, first + count), COLOURINGS)
                for first, count in ((FIRST_TRAINED, self.meshes), (FIRST_HELD, self.meshes // 2))
            )
        path = train_reference(
            train,
            held,
            self.reference,
            self.only,
            lambda done, total: print(f"portraits of {done} of {total}", flush=True),
            lambda epoch, loss: print(f"epoch {epoch}: loss {loss:.4f}", flush=True),
        )
        print(path)


if __name__ == "__main__":
    tyro.cli(Training, description=__doc__).run()
