"""Nearest training sample of each generated one in latent space, streamed from disk file by file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from primdiffusion.people.stored_people import read_payloads
from primdiffusion.primitives.primitives import Payload
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.feature_space.portraits import Report, silent

Encode = Callable[[Payload], Tensor]
"""Encodes a payload as a clean latent: `DiffusionModel.encode`."""


class NearestStored(NamedTuple):
    """The nearest stored sample of each query."""

    distance: Float[Tensor, "q"]
    """Root mean square difference of the latents."""
    file: Int[Tensor, "q"]
    """Index in the paths."""
    colouring: Int[Tensor, "q"]


def nearest_stored(
    queries: Float[Tensor, "q d"], paths: Sequence[Path], encode: Encode, report: Report = silent
) -> NearestStored:
    """Search all colourings of all files for the nearest to each flattened latent. Raises ValueError for no paths."""
    if not paths:
        raise ValueError("no payload files to search: give a folder of payloads")
    best = torch.full((len(queries),), torch.inf)
    file, colouring = (torch.zeros(len(queries), dtype=torch.int64) for _ in range(2))
    for number, path in enumerate(paths):
        encoded = encoded_person(path, encode)
        found = torch.cdist(queries, encoded).min(1)
        nearer = found.values < best
        best = torch.where(nearer, found.values, best)
        file[nearer] = number
        colouring = torch.where(nearer, found.indices, colouring)
        report(number + 1, len(paths))
    return NearestStored(best / queries.shape[1] ** 0.5, file, colouring)


def encoded_person(path: Path, encode: Encode) -> Float[Tensor, "n d"]:
    """Flattened latents of all colourings in a file."""
    person = read_payloads(path)
    return torch.stack([encode(person.payload(one)).flatten().cpu() for one in range(len(person.voxels))])
