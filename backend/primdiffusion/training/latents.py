"""People on disk -> latents in memory: what the diffusion model is trained on."""

from __future__ import annotations

import dataclasses
import json
import random
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from primdiffusion.body.measures import measure
from primdiffusion.body.model import default_body
from primdiffusion.diffusion.codec import LinearCodec, cells_from_voxels, fit_codec
from primdiffusion.diffusion.conditioning import Attributes, Vocabulary
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.people.wardrobe import words_of
from primdiffusion.primitives.primitives import K, S
from primdiffusion.training.config import CodecConfig

_DAMAGED = (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile)
_NO_PERSON = "{path} is no person's payload ({error}): make it again with `primdiffusion payloads`"


@dataclasses.dataclass(frozen=True)
class StoredPerson:
    """One geometry with several colourings, as `people` writes it."""

    voxels: UInt8[Tensor, "n k 8 8 8 4"]
    """sRGB-encoded colour and relative density of each colouring."""
    delta_scale: Float[Tensor, "n k 3"]
    betas: Float[Tensor, "10"]
    attributes: tuple[Attributes, ...]
    """Of each colouring, in the words of `primdiffusion.people.wardrobe`; none where nothing is known."""
    full_density: float
    """1/m that 255 stands for."""


@dataclasses.dataclass(frozen=True)
class LatentSet(TensorRecord):
    """Latents of N people of G geometries."""

    latents: Float[Tensor, "n c 32 32"]
    """float16."""
    geometry: Int[Tensor, "n"]
    """Which geometry each has; those of one geometry lie together."""
    betas: Float[Tensor, "g 10"]
    condition: Float[Tensor, "n a"]
    """All that is known of each person, as `Vocabulary.encode` gives it."""

    def __len__(self) -> int:
        return len(self.latents)


def read_person(path: Path) -> StoredPerson:
    """A person's file; ValueError if it is damaged or of another shape."""
    try:
        with np.load(path, allow_pickle=False) as file:
            voxels = torch.from_numpy(file["voxels"])
            betas = torch.from_numpy(file["betas"]).float()
            attributes = json.loads(str(file["attributes"]))
            full_density = float(file["full_density"])
            delta_scale = torch.from_numpy(file["delta_scale"]).float() if "delta_scale" in file else None
    except _DAMAGED as error:
        raise ValueError(_NO_PERSON.format(path=path, error=error)) from error
    if voxels.dtype != torch.uint8 or tuple(voxels.shape[1:]) != (K, S, S, S, 4):
        raise ValueError(
            f"{path} holds voxels {voxels.dtype} {tuple(voxels.shape)}; uint8 [n, {K}, {S}, {S}, {S}, 4] is needed"
        )
    delta_scale = torch.ones(len(voxels), K, 3) if delta_scale is None else delta_scale
    if tuple(delta_scale.shape) != (len(voxels), K, 3):
        raise ValueError(f"{path} holds delta_scale {tuple(delta_scale.shape)}; [{len(voxels)}, {K}, 3] is needed")
    return StoredPerson(voxels, delta_scale, betas, _attributes_of(attributes, betas, len(voxels)), full_density)


def _attributes_of(stored: dict[str, Any], betas: Float[Tensor, "10"], count: int) -> tuple[Attributes, ...]:
    variants = stored.get("variants", [stored] * count)
    measures = measure(default_body().shape(betas))
    body = {"height": measures.height, "weight": measures.weight}
    return tuple({**words_of(variant), **body} for variant in variants)


def find_people(folder: Path) -> list[Path]:
    """The people's files in a folder, sorted; FileNotFoundError if there are fewer than two."""
    paths = sorted(folder.glob("*.npz"))
    if len(paths) < 2:
        raise FileNotFoundError(
            f"{folder} holds {len(paths)} people (*.npz): make some with `primdiffusion payloads --out {folder}`"
        )
    return paths


def split_people(paths: Sequence[Path], holdout: float, seed: int) -> tuple[list[Path], list[Path]]:
    """Geometries to train on and to hold out (at least one each), the same for the same files and seed."""
    shuffled = random.Random(seed).sample(list(paths), len(paths))
    held = min(max(1, round(holdout * len(paths))), len(paths) - 1)
    return sorted(shuffled[held:]), sorted(shuffled[:held])


def fit_codec_to(paths: Sequence[Path], config: CodecConfig, generator: torch.Generator) -> LinearCodec:
    """The codec of `config.people` random people, one colouring each."""
    chosen = torch.randint(len(paths), (config.people,), generator=generator).tolist()
    if config.people <= len(paths):
        chosen = torch.randperm(len(paths), generator=generator)[: config.people].tolist()
    cells = []
    for index in chosen:
        person = read_person(paths[index])
        one = int(torch.randint(len(person.voxels), (), generator=generator))
        cells.append(cells_from_voxels(person.voxels[one], person.delta_scale[one]))
    return fit_codec(torch.stack(cells), config.channels, generator)


def encode_people(paths: Sequence[Path], codec: LinearCodec, vocabulary: Vocabulary) -> tuple[LatentSet, float]:
    """Latents of every colouring of every person, and their common full density (1/m)."""
    latents, geometry, betas, conditions, densities = [], [], [], [], set()
    for index, path in enumerate(paths):
        person = read_person(path)
        latents.append(codec.encode(cells_from_voxels(person.voxels, person.delta_scale)).half())
        geometry.append(torch.full((len(person.voxels),), index))
        betas.append(person.betas)
        conditions += [vocabulary.encode(_known(each, vocabulary)) for each in person.attributes]
        densities.add(person.full_density)
    if len(densities) != 1:
        raise ValueError(
            f"people with full densities {sorted(densities)} cannot be trained together: regenerate them with one"
        )
    people = LatentSet(torch.cat(latents), torch.cat(geometry), torch.stack(betas), torch.stack(conditions))
    return people, densities.pop()


def _known(attributes: Attributes, vocabulary: Vocabulary) -> Attributes:
    """Those that the vocabulary has a word for: people that are held out may wear what nobody else does."""
    return {
        name: value
        for name, value in attributes.items()
        if name in vocabulary.scalars or value in vocabulary.categories.get(name, ())
    }


def read_vocabulary(paths: Sequence[Path]) -> Vocabulary:
    """What can be said of the people in these files; does not read their voxels."""
    words: dict[str, set[str]] = {}
    numbers: dict[str, list[float]] = {}
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as file:
                stored, betas = json.loads(str(file["attributes"])), torch.from_numpy(file["betas"]).float()
        except _DAMAGED as error:
            raise ValueError(_NO_PERSON.format(path=path, error=error)) from error
        for attributes in _attributes_of(stored, betas, 1):
            for name, value in attributes.items():
                if isinstance(value, str):
                    words.setdefault(name, set()).add(value)
                else:
                    numbers.setdefault(name, []).append(value)
    categories = {name: tuple(sorted(values)) for name, values in words.items()}
    spread = {name: (float(np.mean(values)), float(max(np.std(values), 1e-3))) for name, values in numbers.items()}
    return Vocabulary(categories, spread)
