"""How good generated people are: how far from people nobody was trained on, and whether they are copies.

Sets are compared in a feature space of the people's own attributes (`attribute_network`), in which two sets of real
people are compared as well: nothing can be asked to come closer than those.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.evaluation.attribute_network import (
    AttributeNetwork,
    accuracies,
    features_of,
    fit_attribute_network,
    load_attribute_network,
    save_attribute_network,
)
from primdiffusion.evaluation.distances import Nearest, frechet_distance, kernel_distance, nearest, precision_recall
from primdiffusion.evaluation.gallery import Gallery, ReadPerson, Report, silent, stored_gallery

NETWORK_FILE = "features.safetensors"
PORTRAITS_FOLDER = "portraits"


@dataclasses.dataclass(frozen=True)
class Judge:
    """What generated people are held against."""

    network: AttributeNetwork
    train: Gallery
    held: Gallery
    train_features: Float[Tensor, "n 96"]
    held_features: Float[Tensor, "m 96"]

    @property
    def held_accuracies(self) -> dict[str, float]:
        """How well the network tells the attributes of people it was not trained on."""
        return accuracies(self.network, self.held_features, self.held.attributes)


def open_judge(
    train: Sequence[Path],
    held: Sequence[Path],
    folder: Path,
    read: ReadPerson,
    report: Report = silent,
    report_epoch: Callable[[int, float], None] = lambda epoch, loss: None,
) -> Judge:
    """Portraits and network from `folder`; what is not there is drawn and trained into it, which takes minutes.

    Raises ValueError and FileNotFoundError as the files' readers do.
    """
    drawn, others = (stored_gallery(paths, folder / PORTRAITS_FOLDER, read, report) for paths in (train, held))
    stored = folder / NETWORK_FILE
    if not stored.is_file():
        network = fit_attribute_network(drawn.pictures, drawn.attributes, report=report_epoch)
        save_attribute_network(stored, network)
    network = load_attribute_network(stored)
    return Judge(network, drawn, others, features_of(network, drawn.pictures), features_of(network, others.pictures))


@dataclasses.dataclass(frozen=True)
class Likeness:
    """A set of people against those held out."""

    people: int
    frechet: float
    kernel: float
    precision: float
    recall: float
    nearest_ratio: float
    """Median distance to the nearest training person over that of held-out people: 1 is as new as new people are."""


def liken(judge: Judge, made: Float[Tensor, "n 96"]) -> Likeness:
    """Compares features of made people with the judge's."""
    held = judge.held_features
    to_train = [nearest(features, judge.train_features).distance.median() for features in (made, held)]
    precision, recall = precision_recall(made, held)
    return Likeness(
        len(made),
        frechet_distance(made, held),
        kernel_distance(made, held),
        precision,
        recall,
        float(to_train[0] / to_train[1].clamp_min(1e-12)),
    )


def floor(judge: Judge, count: int, draws: int = 8, seed: int = 0) -> Likeness:
    """Training people against those held out: the mean of some draws of `count` of them.

    Their nearest training person is looked for among the other geometries.
    """
    generator = torch.Generator().manual_seed(seed)
    found = []
    others = nearest_other(judge.train_features, judge.train.geometry)
    to_train = nearest(judge.held_features, judge.train_features).distance.median()
    for _ in range(draws):
        chosen = torch.randperm(len(judge.train_features), generator=generator)[:count]
        likeness = liken(judge, judge.train_features[chosen])
        ratio = float(others.distance[chosen].median() / to_train.clamp_min(1e-12))
        found.append(dataclasses.astuple(dataclasses.replace(likeness, nearest_ratio=ratio)))
    people, *means = (sum(values) / draws for values in zip(*found, strict=True))
    return Likeness(round(people), *means)


def nearest_other(features: Float[Tensor, "n d"], geometry: Int[Tensor, "n"]) -> Nearest:
    """The nearest person of another geometry; people in another colour of clothes are not somebody else."""
    distances, indices = [], []
    for rows, own in zip(features.split(512), geometry.split(512), strict=True):
        table = torch.cdist(rows.double(), features.double())
        table[own[:, None] == geometry] = torch.inf
        found = table.min(1)
        distances.append(found.values)
        indices.append(found.indices)
    return Nearest(torch.cat(distances), torch.cat(indices))


COLUMNS = ("people", "frechet", "kernel", "precision", "recall", "nearest_ratio")


def table(rows: Mapping[str, Likeness]) -> str:
    """Markdown: a row for each set."""
    lines = [
        "| people | number | Frechet distance | kernel distance | precision | recall | nearest training person |",
        "|---" * 7 + "|",
    ]
    for name, row in rows.items():
        values = [f"{getattr(row, column):.4g}" for column in COLUMNS]
        lines.append(f"| {name} | {' | '.join(values)} |")
    return "\n".join(lines)
