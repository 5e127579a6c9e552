"""Quality of generated humans: distance to a held-out set, and whether they copy the training set.

Sets are compared in a feature space of human attributes (`attribute_network`). `real_vs_real` compares two real sets in
the same way: no model can be expected to come closer.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.evaluation.attribute_network import (
    AttributeNetwork,
    features_of,
    load_attribute_network,
)
from primdiffusion.evaluation.distances import (
    Nearest,
    frechet_distance,
    frechet_uncertainty,
    kernel_distance,
    nearest,
    precision_recall,
)
from primdiffusion.evaluation.gallery import Gallery, Report, Source, open_gallery, silent
from primdiffusion.evaluation.markdown import markdown_table

NETWORK_FILE = "features.safetensors"
PORTRAITS_FOLDER = "portraits"
DRAWS = 8
"""Random subsets of the training set that are compared with held-out samples."""


@dataclasses.dataclass(frozen=True)
class ReferenceSet:
    """Training and held-out samples that generated ones are compared with, and their features."""

    network: AttributeNetwork
    train: Gallery
    held: Gallery
    train_features: Float[Tensor, "n f"]
    held_features: Float[Tensor, "m f"]


def open_reference_set(
    train: Sequence[Source], held: Sequence[Source], folder: Path, report: Report = silent
) -> ReferenceSet:
    """Load the network and portraits from `folder`; missing portraits are rendered first, which takes minutes.

    Raises ValueError and FileNotFoundError for missing or unreadable files.
    """
    network = load_attribute_network(folder / NETWORK_FILE)
    drawn, others = (open_gallery(sources, folder / PORTRAITS_FOLDER, report) for sources in (train, held))
    train_features, held_features = (features_of(network, gallery.pictures) for gallery in (drawn, others))
    return ReferenceSet(network, drawn, others, train_features, held_features)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Distances of a set of samples to the held-out set."""

    people: int
    frechet: float
    frechet_std: float
    """How far the distance of as many other samples may lie from it (`frechet_uncertainty`)."""
    kernel: float
    precision: float
    recall: float
    nearest_ratio: float
    """Median distance to the nearest training sample, divided by that of held-out samples: 1 means no copying."""


def compare(reference: ReferenceSet, made: Float[Tensor, "n f"]) -> Comparison:
    """Compare features of generated samples with the held-out and training sets."""
    held = reference.held_features
    to_train = [nearest(features, reference.train_features).distance.median() for features in (made, held)]
    precision, recall = precision_recall(made, held)
    return Comparison(
        len(made),
        frechet_distance(made, held),
        frechet_uncertainty(made, held),
        kernel_distance(made, held),
        precision,
        recall,
        float(to_train[0] / to_train[1].clamp_min(1e-12)),
    )


def real_vs_real(reference: ReferenceSet, count: int) -> Comparison:
    """Training samples compared with held-out ones: the mean over DRAWS random subsets of `count`.

    Nearest training samples are searched among other geometries only.
    """
    generator = torch.Generator().manual_seed(0)
    found = []
    others = nearest_other(reference.train_features, reference.train.geometry)
    to_train = nearest(reference.held_features, reference.train_features).distance.median()
    for _ in range(DRAWS):
        chosen = torch.randperm(len(reference.train_features), generator=generator)[:count]
        comparison = compare(reference, reference.train_features[chosen])
        ratio = float(others.distance[chosen].median() / to_train.clamp_min(1e-12))
        found.append(dataclasses.astuple(dataclasses.replace(comparison, nearest_ratio=ratio)))
    people, *means = (sum(values) / DRAWS for values in zip(*found, strict=True))
    return Comparison(round(people), *means)


def nearest_other(features: Float[Tensor, "n d"], geometry: Int[Tensor, "n"]) -> Nearest:
    """Nearest sample of another geometry: recoloured clothes do not make another human."""
    return nearest(features, features, geometry[:, None] == geometry)


COLUMNS = {
    "people": "number",
    "frechet": "Frechet distance",
    "frechet_std": "+-",
    "kernel": "kernel distance",
    "precision": "precision",
    "recall": "recall",
    "nearest_ratio": "nearest training person",
}


def table(rows: Mapping[str, Comparison]) -> str:
    """Format as a Markdown table, a row a set."""
    texts = [[name, *(f"{getattr(row, column):.4g}" for column in COLUMNS)] for name, row in rows.items()]
    return markdown_table(["people", *COLUMNS.values()], texts)
