"""Portraits of stored samples, cached in a folder, and of generated ones."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from primdiffusion.evaluation.portraits import PORTRAITS, SIDE, portraits
from primdiffusion.geometry.srgb import decode_srgb
from primdiffusion.people.payloads import rest_frames
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.staging import written_whole


class StoredPerson(Protocol):
    """One geometry in n colourings, as `training.latents.read_person` returns it (evaluation imports no training)."""

    @property
    def voxels(self) -> UInt8[Tensor, "n k 8 8 8 4"]:
        """sRGB-encoded colour and relative density."""
        ...

    @property
    def delta_scale(self) -> Float[Tensor, "n k 3"]:
        """Factors on the boxes' rest extents."""
        ...

    @property
    def betas(self) -> Float[Tensor, "10"]:
        """Body shape."""
        ...

    @property
    def full_density(self) -> float:
        """Density that 255 encodes, 1/m."""
        ...


ReadPerson = Callable[[Path], StoredPerson]
Report = Callable[[int, int], None]
"""Progress callback: done, total."""


def silent(done: int, total: int) -> None:
    """Ignore progress."""


@dataclasses.dataclass(frozen=True)
class Gallery:
    """Portraits of n samples of g geometries."""

    pictures: UInt8[Tensor, "n v h w 4"]
    geometry: Int[Tensor, "n"]
    """Index of each sample's file; ascending."""
    attributes: tuple[dict[str, Any], ...]


def payload_of(person: StoredPerson, colouring: int) -> Payload:
    """Decode one colouring to linear colour and density in 1/m."""
    voxels = person.voxels[colouring].movedim(-1, -4).float() / 255
    return Payload(decode_srgb(voxels[:, :3]), voxels[:, 3] * person.full_density, person.delta_scale[colouring])


def stored_gallery(paths: Sequence[Path], folder: Path, read: ReadPerson, report: Report = silent) -> Gallery:
    """Portraits of all colourings of the files; cached in `folder`, rendered where they are missing or damaged."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures, attributes = [], []
    for number, path in enumerate(paths):
        pictures.append(_cached(folder / path.name) if (folder / path.name).is_file() else None)
        if pictures[-1] is None:
            pictures[-1] = _rendered(read(path))
            with written_whole(folder / path.name) as unfinished, unfinished.open("wb") as file:
                np.savez_compressed(file, pictures=pictures[-1].numpy())
        known = read_attributes(path, len(pictures[-1]))
        attributes += known
        report(number + 1, len(paths))
    counts = torch.tensor([len(one) for one in pictures])
    return Gallery(torch.cat(pictures), torch.arange(len(paths)).repeat_interleave(counts), tuple(attributes))


def _rendered(person: StoredPerson) -> UInt8[Tensor, "n v h w 4"]:
    frames = rest_frames(person.betas.numpy())
    return torch.stack(
        [portraits(Primitives.place(frames, payload_of(person, number))) for number in range(len(person.voxels))]
    )


def _cached(path: Path) -> Tensor | None:
    """Pictures from an earlier run; None if they are damaged or of other views."""
    try:
        with np.load(path, allow_pickle=False) as file:
            pictures = torch.from_numpy(file["pictures"])
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        return None
    return pictures if tuple(pictures.shape[1:]) == (len(PORTRAITS), SIDE, SIDE, 4) else None


def read_attributes(path: Path, colourings: int) -> list[dict[str, Any]]:
    """Read the attributes of each colouring in a payload file. Raises ValueError if they are unreadable."""
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = json.loads(str(file["attributes"]))
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path} is not a payload file ({error}): make it again with `primdiffusion payloads`"
        ) from error
    return list(stored.get("variants", [stored] * colourings))


def made_gallery(samples: Iterable[Primitives]) -> UInt8[Tensor, "n v h w 4"]:
    """Portraits of generated samples; the iterable is consumed one by one."""
    return torch.stack([portraits(primitives) for primitives in samples])
