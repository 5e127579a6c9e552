"""Encode stored people as latents in memory, the training set of the diffusion model."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.diffusion.codec import LinearCodec, cells_from_voxels, fit_codec
from primdiffusion.diffusion.conditioning import Attributes, AttributeVocabulary
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.people.stored_people import PersonFolder
from primdiffusion.training.config import CodecConfig

Item = TypeVar("Item", int, Path)
CHUNK = 256
"""Samples whose latents are in float32 at once."""


@dataclasses.dataclass(frozen=True)
class LatentSet(TensorRecord):
    """Latents of N samples of G geometries, the detailed ones first."""

    latents: Float[Tensor, "n c 32 32"]
    """float16."""
    geometry: Int[Tensor, "n"]
    """Geometry of each sample; ascending."""
    betas: Float[Tensor, "g 10"]
    condition: Float[Tensor, "n a"]
    """All attributes of each person, as `AttributeVocabulary.encode`."""
    detailed: Int[Tensor, ""]
    """Number of samples to learn detail from; `renew_closed_form` appends softer ones."""

    def __len__(self) -> int:
        return len(self.latents)


def split_people(people: Sequence[Item], holdout: float, seed: int) -> tuple[list[Item], list[Item]]:
    """Geometries to train on and to hold out (at least one each); deterministic for a number and a seed."""
    shuffled = random.Random(seed).sample(list(people), len(people))
    held = min(max(1, round(holdout * len(people))), len(people) - 1)
    return sorted(shuffled[held:]), sorted(shuffled[:held])


def fit_codec_to(
    people: PersonFolder, indices: Sequence[int], config: CodecConfig, generator: torch.Generator
) -> LinearCodec:
    """Fit the codec to `config.people` random geometries among `indices`, one colouring each."""
    chosen = torch.randint(len(indices), (config.people,), generator=generator).tolist()
    if config.people <= len(indices):
        chosen = torch.randperm(len(indices), generator=generator)[: config.people].tolist()
    cells = []
    for place in chosen:
        index = indices[place]
        number = int(torch.randint(people.variants[index], (), generator=generator))
        cells.append(cells_from_voxels(*people.variant(index, number)))
    return fit_codec(torch.stack(cells), config.channels, generator)


def encode_people(
    people: PersonFolder, indices: Sequence[int], codec: LinearCodec, vocabulary: AttributeVocabulary
) -> LatentSet:
    """Encode all colourings of the geometries `indices`."""
    latents, geometry, betas, conditions = [], [], [], []
    for place, index in enumerate(indices):
        person = people.person(index)
        latents.append(codec.encode(cells_from_voxels(person.voxels, person.delta_scale)).half())
        geometry.append(torch.full((len(person.voxels),), place))
        betas.append(person.betas)
        conditions += [vocabulary.encode(_known(each, vocabulary)) for each in person.attributes]
    count = torch.tensor(len(conditions))
    return LatentSet(torch.cat(latents), torch.cat(geometry), torch.stack(betas), torch.stack(conditions), count)


def _known(attributes: Attributes, vocabulary: AttributeVocabulary) -> Attributes:
    """Drop attributes missing from the vocabulary: held-out people may have values that no training sample has."""
    return {
        name: value
        for name, value in attributes.items()
        if name in vocabulary.scalars or value in vocabulary.categories.get(name, ())
    }


def vocabulary_of(people: Iterable[Attributes]) -> AttributeVocabulary:
    """Collect the vocabulary of these people: all values of categories, mean and standard deviation of numbers."""
    words: dict[str, set[str]] = {}
    numbers: dict[str, list[float]] = {}
    for attributes in people:
        for name, value in attributes.items():
            if isinstance(value, str):
                words.setdefault(name, set()).add(value)
            else:
                numbers.setdefault(name, []).append(value)
    categories = {name: tuple(sorted(values)) for name, values in words.items()}
    spread = {name: (float(np.mean(values)), float(max(np.std(values), 1e-3))) for name, values in numbers.items()}
    return AttributeVocabulary(categories, spread)
