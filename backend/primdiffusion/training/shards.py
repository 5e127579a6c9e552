"""Shards: many people in few memory-mapped files, each with a checksum.

    index.json                 format, full density; of every shard its SHA-256 and its people; written last
    shard_NNNN.safetensors     some tens of people: voxels uint8 [n, K, 8, 8, 8, 4], betas [people, 10] and, where boxes
                               differ from the anchors', delta_scale float16 [n, K, 3]; a person's n lie together

A colouring takes 2 MiB and is read alone, without unpacking anything: files of single people are a third as large, but
have to be unpacked whole. Shards hold the same bytes as the files they are made from.
"""

from __future__ import annotations

import bisect
import collections
import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import torch
from torch import Tensor

from primdiffusion.diffusion.conditioning import Attributes
from primdiffusion.diffusion.model import BETAS
from primdiffusion.files import tensor_file
from primdiffusion.files.arrays import LARGEST_NUMBER
from primdiffusion.files.json_files import read_json
from primdiffusion.files.regular_files import FileError, as_file_error, is_plain_path, open_regular
from primdiffusion.files.tensor_file import TensorFile
from primdiffusion.files.whole_files import remove_abandoned, staged, write_atomically, written_whole
from primdiffusion.primitives.primitives import K, S
from primdiffusion.training.stored_people import PersonDataset, PersonFolder, PersonVariants, attributes_of

INDEX, FORMAT, VERSION = "index.json", "primdiffusion-payloads", 1
PEOPLE_EACH = 32
LARGEST_SHARD = 4 * 2**30
"""Bytes."""
_TYPES = {"voxels": (torch.uint8,), "betas": (torch.float32,), "delta_scale": (torch.float16, torch.float32)}


def open_people(folder: Path) -> PersonDataset:
    """Open the people of a folder: shards if there is an index, files of single people otherwise.

    Raises:
        FileNotFoundError: there are fewer than two.
        ValueError: a file or the index is damaged, or people have several full densities.
    """
    return PackedPeople(folder) if (folder / INDEX).exists() else PersonFolder(folder)


def pack_people(folder: Path, out: Path, people_each: int = PEOPLE_EACH) -> Iterator[int]:
    """Write the people of a folder as shards; yields the number packed so far. After an error nothing is left.

    Raises:
        ValueError: `out` holds packed people already, or a person's file is damaged (it is named); no people a shard.
        FileNotFoundError: there are fewer than two people.
        OSError: there is no room.
    """
    if people_each < 1:
        raise ValueError(f"{people_each} humans per shard: choose 1 or more")
    if (out / INDEX).exists():
        remove_abandoned(out)  # of a process that was killed after the index had its place
        raise FileError(out, "already contains shards", "choose another folder, or remove it")
    people = PersonFolder(folder)
    with staged(out, last=INDEX) as unfinished:
        shards, done = [], 0
        for number, first in enumerate(range(0, len(people.names), people_each)):
            indices = range(first, min(first + people_each, len(people.names)))
            path = unfinished / f"shard_{number:04d}.safetensors"
            _write_shard(path, [people.person(index) for index in indices])
            about = [
                {"name": people.names[i], "variants": people.variants[i], "attributes": dict(people.outlines[i].stored)}
                for i in indices
            ]
            shards.append({"file": path.name, "sha256": digest_of(path), "people": about})
            done += len(indices)
            yield done
        index = {"format": FORMAT, "version": VERSION, "full_density": people.full_density, "shards": shards}
        write_atomically(unfinished / INDEX, json.dumps(index, indent=1))


def _write_shard(path: Path, people: Sequence[PersonVariants]) -> None:
    tensors = {
        "voxels": torch.cat([person.voxels for person in people]),
        "betas": torch.stack([person.betas for person in people]),
    }
    scales = torch.cat([person.delta_scale for person in people])
    if (scales != 1).any():
        tensors["delta_scale"] = scales.half()
    with written_whole(path) as unfinished:
        unfinished.write_bytes(tensor_file.save(tensors))


def digest_of(path: Path) -> str:
    """SHA-256 of a regular file, hexadecimal. Raises OSError and FileError."""
    with open_regular(path, LARGEST_SHARD) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def damaged_shards(folder: Path) -> list[str]:
    """Return an error message for each damaged shard; raises FileError for a damaged index."""
    people, found = PackedPeople(folder), []
    for number in range(len(people.paths)):
        try:
            people.check(number)
        except (FileError, OSError) as error:
            found.append(str(error))
    return found


class PackedPeople:
    """People in shards; each shard is checked against its SHA-256 when first read (half a second for 256 MiB)."""

    def __init__(self, folder: Path) -> None:
        """Read the index. Raises FileNotFoundError, and FileError if it is damaged or of another version."""
        self._index = folder / INDEX
        index = _read_index(self._index)
        with as_file_error(folder / INDEX, "is damaged", "pack the humans again"):
            self.full_density = float(index["full_density"])
            _check_distinct([str(shard["file"]) for shard in index["shards"]])
            self.paths = [folder / _plain_name(shard["file"]) for shard in index["shards"]]
            self._digests = [str(shard["sha256"]) for shard in index["shards"]]
            people = [person for shard in index["shards"] for person in shard["people"]]
            self.names: Sequence[str] = [str(person["name"]) for person in people]
            self.variants: Sequence[int] = [_count(person["variants"]) for person in people]
            self._stored: Sequence[Mapping[str, Any]] = [dict(person["attributes"]) for person in people]
            self._firsts = [0, *itertools.accumulate(len(shard["people"]) for shard in index["shards"])]
        if len(self.names) < 2:
            raise FileNotFoundError(f"{folder / INDEX} lists {len(self.names)} humans: training needs two or more")
        self._open: dict[int, TensorFile] = {}

    def known(self, index: int) -> tuple[Attributes, ...]:
        """Return the attributes of each colouring of a person. Raises as `person`."""
        shard, place, _ = self._rows(index)
        betas = self._slice(shard, "betas")[place]
        with as_file_error(self._index, f"is damaged: the attributes of {self.names[index]!r:.60}", "pack again"):
            return attributes_of(self._stored[index], betas, self.variants[index])

    def person(self, index: int) -> PersonVariants:
        """Read a person. Raises FileError, naming a damaged shard, and OSError."""
        shard, place, rows = self._rows(index)
        voxels, scale, betas = self._slice(shard, "voxels")[rows], self._scale(shard, rows), self._slice(shard, "betas")
        return PersonVariants(voxels, scale, betas[place], self.known(index), self.full_density)

    def variant(self, index: int, number: int) -> tuple[Tensor, Tensor]:
        """Read voxels and delta scales of one colouring. Raises as `person`."""
        shard, _, rows = self._rows(index)
        row = slice(rows.start + number, rows.start + number + 1)
        return self._slice(shard, "voxels")[row][0], self._scale(shard, row)[0]

    def check(self, shard: int) -> None:
        """Check a shard against its SHA-256. Raises FileError, FileNotFoundError."""
        path = self.paths[shard]
        if not path.is_file():
            raise FileNotFoundError(f"there is no {path}, which {INDEX} names: pack the humans again")
        if digest_of(path) != self._digests[shard]:
            raise FileError(path, f"is damaged: its SHA-256 differs from {INDEX}", "pack the humans again")

    def _check_content(self, number: int, file: TensorFile) -> None:
        people = range(self._firsts[number], self._firsts[number + 1])
        rows = sum(self.variants[index] for index in people)
        wanted = {"voxels": [rows, K, S, S, S, 4], "betas": [len(people), BETAS], "delta_scale": [rows, K, 3]}
        for name, shape in wanted.items():
            if name == "delta_scale" and name not in file.names:
                continue
            if name not in file.names:
                raise ValueError(f"{name!r} is missing")
            stored = file.tensor(name)
            if list(stored.shape) != shape or stored.dtype not in _TYPES[name]:
                raise ValueError(f"{name!r} is {stored.dtype} {list(stored.shape)}, not {shape}")
            if name != "voxels" and not (stored.float().abs() <= LARGEST_NUMBER).all():
                raise ValueError(f"{name!r} holds impossible numbers")

    def _rows(self, index: int) -> tuple[int, int, slice]:
        """Return the shard of a person, the index in it, and the rows."""
        shard = bisect.bisect_right(self._firsts, index) - 1
        first = self._firsts[shard]
        start = sum(self.variants[first:index])
        return shard, index - first, slice(start, start + self.variants[index])

    def _scale(self, shard: int, rows: slice) -> Tensor:
        if "delta_scale" in self._shard(shard).names:
            return self._slice(shard, "delta_scale")[rows].float()
        return torch.ones(rows.stop - rows.start, K, 3)

    def _slice(self, shard: int, name: str) -> Tensor:
        return self._shard(shard).tensor(name)

    def _shard(self, number: int) -> TensorFile:
        if number not in self._open:
            self.check(number)
            with as_file_error(self.paths[number], "is not a shard", "pack the humans again"):
                file = TensorFile(self.paths[number], LARGEST_SHARD)
                self._check_content(number, file)
            self._open[number] = file
        return self._open[number]


def _check_distinct(names: Sequence[str]) -> None:
    """Raise ValueError for a shard that is listed twice: each listing would read its gigabytes again."""
    if len(set(names)) < len(names):
        twice = next(name for name, count in collections.Counter(names).items() if count > 1)
        raise ValueError(f"it lists the shard {twice!r:.60} more than once")


def _count(variants: Any) -> int:
    if type(variants) is not int or variants < 1:
        raise ValueError(f"a human has {variants!r:.20} colourings")
    return variants


def _plain_name(name: Any) -> str:
    plain = isinstance(name, str) and is_plain_path(name) and PurePath(name).name == name and name != ".."
    if not plain or "\\" in name:
        raise ValueError(f"{name!r:.60} is not the name of a file beside it")
    return name


def _read_index(path: Path) -> dict[str, Any]:
    try:
        index = read_json(path)
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no {path}: pack humans with `primdiffusion payloads pack`") from None
    except ValueError as error:
        raise FileError(path, f"is damaged ({error!s:.100})", "pack the humans again") from error
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise FileError(path, "is not the index of packed humans", "choose another folder")
    if index.get("version") != VERSION:
        version = index.get("version")
        raise FileError(path, f"has version {version!s:.20}, this program reads {VERSION}", "pack again")
    return index
