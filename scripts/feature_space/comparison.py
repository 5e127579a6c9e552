"""Quality of generated humans: distance to a held-out set, and whether they copy the training set.

Sets are compared in a feature space of human attributes (`attribute_network`). `real_vs_real` compares two real sets in
the same way: no model can be expected to come closer.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from primdiffusion.evaluation.images import markdown_table
from primdiffusion.evaluation.metrics import check_features, frechet_distance, kernel_distance
from primdiffusion.people.assets import open_assets
from primdiffusion.people.stored_people import find_payloads
from primdiffusion.training.latents import split_people
from torch import Tensor

from scripts.feature_space.network import AttributeNetwork, features_of, load_attribute_network
from scripts.feature_space.portraits import (
    COLOURINGS,
    Gallery,
    Report,
    Source,
    mesh_sources,
    open_gallery,
    payload_sources,
    read_seed,
    silent,
)

NEIGHBOURS = 3
"""k of precision and recall (Kynkäänniemi et al. 2019)."""
REDRAWS = 20
"""Bootstrap sets that the uncertainty of a distance is estimated from."""
ROWS_AT_ONCE = 512
"""Rows of a distance matrix computed at a time; limits memory, no effect on the result."""
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


def real_sources(people: Path, assets: Path | None, holdout: float, seed: int) -> tuple[list[Source], list[Source]]:
    """Portraits of the people that a model was trained on, and of those held out: of payloads, or of `assets`' meshes.

    Raises ValueError and FileNotFoundError for people or assets that are missing or unreadable.
    """
    split = split_people(find_payloads(people), holdout, seed)
    if assets is None:
        train, held = (payload_sources(paths) for paths in split)
        return train, held
    opened = open_assets(assets)
    train, held = (mesh_sources(opened, [read_seed(path) for path in paths], COLOURINGS) for paths in split)
    return train, held


def frechet_uncertainty(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> float:
    """Standard deviation of the Frechet distance when other samples are drawn: over REDRAWS bootstrap sets of `first`.

    A few samples far from the others move the distance by more than models differ.
    """
    generator = torch.Generator().manual_seed(0)
    redrawn = [torch.randint(len(first), (len(first),), generator=generator) for _ in range(REDRAWS)]
    return float(np.std([frechet_distance(first[chosen], second) for chosen in redrawn], ddof=1))


class PrecisionRecall(NamedTuple):
    """Fractions in [0, 1]; both are 1 for sets that cover each other."""

    precision: float
    """Fraction of generated samples within the real set."""
    recall: float
    """Fraction of real samples within the generated set."""


def precision_recall(made: Float[Tensor, "n d"], real: Float[Tensor, "m d"]) -> PrecisionRecall:
    """Improved precision and recall (Kynkäänniemi et al. 2019, eq. 1-2).

    A set is the union of balls around its samples, each reaching to the nearest neighbour of number NEIGHBOURS in that
    set. Raises ValueError for sets of as many or fewer.
    """
    check_features(made, real)
    if min(len(made), len(real)) <= NEIGHBOURS:
        raise ValueError(
            f"sets of {len(made)} and {len(real)} samples are too small for {NEIGHBOURS} neighbours: use larger sets"
        )

    def covered(points: Tensor, centres: Tensor) -> float:
        own = torch.cdist(centres, centres).kthvalue(NEIGHBOURS + 1, dim=1).values  # the nearest is the sample itself
        return float((torch.cdist(points, centres) <= own).any(1).double().mean())

    made, real = made.double(), real.double()
    return PrecisionRecall(covered(made, real), covered(real, made))


class Nearest(NamedTuple):
    """The nearest neighbour of each query."""

    distance: Float[Tensor, "q"]
    index: Int[Tensor, "q"]


def nearest(
    queries: Float[Tensor, "q d"], among: Float[Tensor, "n d"], left_out: Bool[Tensor, "q n"] | None = None
) -> Nearest:
    """Find Euclidean nearest neighbours, except pairs `left_out`.

    Raises ValueError for an empty set or features of different widths.
    """
    if queries.shape[-1] != among.shape[-1] or not len(among):
        raise ValueError(f"queries {tuple(queries.shape)} do not match the set {tuple(among.shape)}: same width, n > 0")
    found = []
    for first in range(0, len(queries), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        table = torch.cdist(queries[rows].double(), among.double())
        found.append((table if left_out is None else table.masked_fill(left_out[rows], torch.inf)).min(1))
    return Nearest(torch.cat([part.values for part in found]), torch.cat([part.indices for part in found]))
