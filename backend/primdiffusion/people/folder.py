"""Write humans as a folder of rigged glTF files, from which captures are rendered.

    person_NNNNNN/person.glb         NNNNNN is the seed
    person_NNNNNN/person.json        seed, betas, attributes

Each folder is written atomically, so that an interrupted run can be resumed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from primdiffusion.body.model import default_body
from primdiffusion.files.json_files import read_json
from primdiffusion.files.regular_files import remove_folder
from primdiffusion.files.whole_files import remove_abandoned, temporary_name
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.requests import Count, Seed, check_seed
from primdiffusion.formats.schema import Checked
from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.gltf import Skeleton, glb
from primdiffusion.people.person import Person, make_person
from primdiffusion.runtime.worker_process import each

GLB, CARD = "person.glb", "person.json"
BODY = "default"
JOINT_GRID = 2.0**20
"""Joints are rounded to 1 / JOINT_GRID m, so that files do not depend on the order of summation."""
PERSON = re.compile(r"person_\d{6,}")


@dataclasses.dataclass(frozen=True)
class PeopleSet(Checked):
    """The samples of a folder: seeds seed ... seed + count - 1."""

    root: Path
    seed: Seed
    count: Count

    def __post_init__(self) -> None:
        """Raise ValueError if count is not positive, or a seed is outside 0 ... 2^63-1."""
        super().__post_init__()
        check_seed(self.seed + self.count - 1)

    @property
    def seeds(self) -> range:
        """Seeds of all samples."""
        return range(self.seed, self.seed + self.count)

    def folder(self, seed: int) -> Path:
        """Folder of one sample."""
        return self.root / name_of(seed)


def name_of(seed: int) -> str:
    """Name of a sample's folder."""
    return f"person_{seed:06d}"


def make_people(assets: Assets, people: PeopleSet, workers: int) -> Iterator[int]:
    """Write missing samples; yields the number of finished ones, starting with the existing.

    A sample takes about one second on one core. Files are deterministic for a seed, whatever the number of workers.

    Raises:
        ValueError: the folder contains other samples; a worker process was killed.
        FileNotFoundError, FileError: asset files are missing or damaged.
        OSError: a file cannot be written.
    """
    if workers < 1:
        raise ValueError(f"workers is {workers}: give 1 or more")
    _check_folder(people)
    people.root.mkdir(parents=True, exist_ok=True)
    remove_abandoned(people.root, after_s=0)
    missing = [seed for seed in people.seeds if not is_there(people.folder(seed), seed)]
    done = people.count - len(missing)
    yield done
    jobs = [(assets, people.folder(seed), seed) for seed in missing]
    for _ in each(write_person, jobs, max(1, min(workers, len(jobs)))):
        done += 1
        yield done


def write_person(assets: Assets, folder: Path, seed: int) -> None:
    """Generate one sample and write its folder, atomically; an existing folder is replaced."""
    person = make_person(assets, load_base_mesh(), seed)
    binary = glb(person.mesh, skeleton_of(person), {"primdiffusion": _identity(person, seed)})
    card = {**_identity(person, seed), "attributes": person.attributes}
    partial = temporary_name(folder)
    try:
        partial.mkdir()
        (partial / GLB).write_bytes(binary)
        (partial / CARD).write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8", newline="\n")
        remove_folder(folder, folder.parent)
        partial.replace(folder)
    except OSError as error:
        # For a full disk, Python's error names no file.
        raise OSError(error.errno, error.strerror or "cannot be written", str(folder)) from error
    finally:
        remove_folder(partial, partial.parent)


def skeleton_of(person: Person) -> Skeleton:
    """The default body's joints at the sample's betas."""
    body = default_body()
    vertices = body.template.double() + torch.einsum(
        "vcn,n->vc", body.shape_basis[..., : len(person.betas)].double(), torch.from_numpy(person.betas)
    )
    joints = (body.joint_regressor.double() @ vertices).numpy()
    return Skeleton(JOINT_NAMES, body.parents.tolist(), np.rint(joints * JOINT_GRID) / JOINT_GRID + 0.0)


def is_there(folder: Path, seed: int) -> bool:
    """Whether a folder contains this sample: folders appear whole or not at all."""
    with contextlib.suppress(OSError, ValueError):
        card = read_json(folder / CARD)
        return isinstance(card, dict) and card.get("seed") == seed
    return False


def _identity(person: Person, seed: int) -> dict[str, Any]:
    return {"seed": seed, "betas": person.betas.tolist(), "body": BODY}


def _check_folder(people: PeopleSet) -> None:
    """Raise ValueError if the folder has samples outside the range."""
    expected = {name_of(seed) for seed in people.seeds}
    found = [path.name for path in people.root.glob("person_*") if PERSON.fullmatch(path.name)]
    unexpected = sorted(set(found) - expected)
    if unexpected:
        raise ValueError(
            f"{people.root} contains {unexpected[0]} ({len(unexpected)} out of range), but {people.count} from seed "
            f"{people.seed} were requested: choose another folder, or a range with all that it contains"
        )
