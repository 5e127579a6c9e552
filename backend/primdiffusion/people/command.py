"""Commands that make humans from an asset folder: rigged files to render, or primitives to train on."""

from __future__ import annotations

import dataclasses
import os
import sys
from pathlib import Path

from tqdm import tqdm

from primdiffusion.people.assets import open_assets
from primdiffusion.people.folder import PeopleSet, make_people, unknown_licences
from primdiffusion.people.payloads import Making, make_payloads
from primdiffusion.people.wardrobe import required_meshes


@dataclasses.dataclass(frozen=True)
class PeopleCommand:
    """Make dressed, rigged humans as glTF files, from which captures are rendered."""

    out: Path
    """Folder to write person_NNNNNN/person.glb and manifest.json into; complete ones are skipped."""
    assets: Path | None = None
    """MakeHuman asset folder (CC0); the default is the environment variable PRIMDIFFUSION_ASSETS."""
    count: int = 100
    """Number of humans."""
    seed: int = 0
    """Seed of the first human; the others have the following seeds."""
    workers: int = os.cpu_count() or 1
    """Processes; each needs a core and about 1 GB."""


@dataclasses.dataclass(frozen=True)
class PayloadsCommand:
    """Make dressed humans as primitives: the training set of the diffusion model.

    `payloads encode` makes them from captures instead; `payloads pack` stores either in few files, whose checksums
    `payloads verify` compares (each with its own --help).
    """

    out: Path
    """Folder to write person_NNNNNN.npz into; complete ones are skipped."""
    assets: Path | None = None
    """MakeHuman asset folder (CC0); the default is the environment variable PRIMDIFFUSION_ASSETS."""
    count: int = 100
    """Number of humans."""
    variants: int = 4
    """Colourings of each human."""
    seed: int = 0
    """Seed of the first human; the others have the following seeds."""
    making: Making = "fitted"
    """fitted: the primitives are fitted to renders of the mesh, about 30 s per human and core; from_mesh: each voxel
    takes the colour of the nearest surface point, 2 s, blurred."""
    workers: int = os.cpu_count() or 1
    """Processes; each needs a core and about 1.5 GB."""


def run_people(command: PeopleCommand) -> None:
    """Make the humans, show progress, and print the folder."""
    people = PeopleSet(command.out, command.seed, command.count)
    assets = open_assets(command.assets, required_meshes())
    with tqdm(total=command.count, unit="person", desc="people", disable=None) as bar:
        for done in make_people(assets, people, command.workers):
            bar.update(done - bar.n)
    unknown = unknown_licences(command.out)
    if unknown:
        print(
            f"primdiffusion: {len(unknown)} asset files state no licence ({unknown[0]}, ...), so the manifest lists it "
            "as unknown: list them in a LICENSES.txt beside the asset folder",
            file=sys.stderr,
        )
    print(command.out)


def run_payloads(command: PayloadsCommand) -> None:
    """Make the payloads and show progress."""
    assets = open_assets(command.assets, required_meshes())
    with tqdm(total=command.count, unit="person", desc="payloads") as bar:

        def report(done: int, total: int) -> None:
            bar.update(done - bar.n)

        make_payloads(
            assets, command.out, command.count, command.variants, command.seed, command.workers, command.making, report
        )
