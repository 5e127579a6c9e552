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

from primdiffusion.diffusion.codec import LinearCodec, cells_from_voxels, fit_codec
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import K, S
from primdiffusion.training.config import CodecConfig

_DAMAGED = (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile)
_NO_PERSON = "{path} is no person's payload ({error}): make it again with `primdiffusion payloads`"


@dataclasses.dataclass(frozen=True)
class StoredPerson:
    """One geometry with several colourings, as `people` writes it."""

    voxels: UInt8[Tensor, "n k 8 8 8 4"]
    """sRGB-encoded colour and relative density of each colouring."""
    betas: Float[Tensor, "10"]
    attributes: dict[str, Any]
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
    label: Int[Tensor, "g"]
    """Number of the outfit of each geometry."""

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
    except _DAMAGED as error:
        raise ValueError(_NO_PERSON.format(path=path, error=error)) from error
    if voxels.dtype != torch.uint8 or tuple(voxels.shape[1:]) != (K, S, S, S, 4):
        raise ValueError(
            f"{path} holds voxels {voxels.dtype} {tuple(voxels.shape)}; uint8 [n, {K}, {S}, {S}, {S}, 4] is needed"
        )
    return StoredPerson(voxels, betas, attributes, full_density)


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
        voxels = read_person(paths[index]).voxels
        cells.append(cells_from_voxels(voxels[int(torch.randint(len(voxels), (), generator=generator))]))
    return fit_codec(torch.stack(cells), config.channels, generator)


def encode_people(paths: Sequence[Path], codec: LinearCodec, outfits: Sequence[str]) -> tuple[LatentSet, float]:
    """Latents of every colouring of every person, and their common full density (1/m)."""
    latents, geometry, betas, labels, densities = [], [], [], [], set()
    for index, path in enumerate(paths):
        person = read_person(path)
        latents.append(codec.encode(cells_from_voxels(person.voxels)).half())
        geometry.append(torch.full((len(person.voxels),), index))
        betas.append(person.betas)
        labels.append(outfits.index(outfit_of(person.attributes)))
        densities.add(person.full_density)
    if len(densities) != 1:
        raise ValueError(
            f"people with full densities {sorted(densities)} cannot be trained together: regenerate them with one"
        )
    return LatentSet(torch.cat(latents), torch.cat(geometry), torch.stack(betas), torch.tensor(labels)), densities.pop()


def outfit_of(attributes: dict[str, Any]) -> str:
    """The name of a person's outfit; one name for people without."""
    return str(attributes.get("outfit", "unknown"))


def read_outfits(paths: Sequence[Path]) -> list[str]:
    """The names of all outfits worn, sorted; does not read the people's voxels."""
    outfits = set()
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as file:
                outfits.add(outfit_of(json.loads(str(file["attributes"]))))
        except _DAMAGED as error:
            raise ValueError(_NO_PERSON.format(path=path, error=error)) from error
    return sorted(outfits)
