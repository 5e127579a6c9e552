"""The commands that make people from an asset folder: rigged files to render, or primitives to train on."""

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
    """Make dressed, rigged people as glTF files: what captures are rendered from."""

    out: Path
    """Folder to write person_NNNNNN/person.glb and manifest.json into; people that are whole in it are kept."""
    assets: Path | None = None
    """MakeHuman asset folder (CC0); without it the environment variable PRIMDIFFUSION_ASSETS is asked."""
    count: int = 100
    """People to make."""
    seed: int = 0
    """Seed of the first person; the next has the next."""
    workers: int = os.cpu_count() or 1
    """Processes; each takes a core and about 1 GB."""


@dataclasses.dataclass(frozen=True)
class PayloadsCommand:
    """Make dressed people as primitives: the training set of the diffusion model.

    `payloads encode` makes it of captures instead; `payloads pack` stores either in few files, which `payloads verify`
    compares with their checksums (each with its own --help).
    """

    out: Path
    """Folder to write person_NNNNNN.npz into; people that are whole in it are kept."""
    assets: Path | None = None
    """MakeHuman asset folder (CC0); without it the environment variable PRIMDIFFUSION_ASSETS is asked."""
    count: int = 100
    """People to make."""
    variants: int = 4
    """Colourings of each."""
    seed: int = 0
    """Seed of the first person; the next has the next."""
    making: Making = "fitted"
    """fitted: the primitives are fitted to renders of the mesh, about 30 s a person and core; from_mesh: each voxel
    takes the colour of the nearest surface point, 2 s, blurred."""
    workers: int = os.cpu_count() or 1
    """Processes; each takes a core and about 1.5 GB."""


def run_people(command: PeopleCommand) -> None:
    """Makes the people, shows how far it is, and prints the folder."""
    people = PeopleSet(command.out, command.seed, command.count)
    assets = open_assets(command.assets, required_meshes())
    with tqdm(total=command.count, unit="person", desc="people", disable=None) as bar:
        for done in make_people(assets, people, command.workers):
            bar.update(done - bar.n)
    unknown = unknown_licences(command.out)
    if unknown:
        print(
            f"primdiffusion: {len(unknown)} asset files state no licence ({unknown[0]}, ...): the manifest calls it "
            "unknown; list them in a LICENSES.txt beside the asset folder",
            file=sys.stderr,
        )
    print(command.out)


def run_payloads(command: PayloadsCommand) -> None:
    """Makes the payloads and shows how far it is."""
    assets = open_assets(command.assets, required_meshes())
    with tqdm(total=command.count, unit="person", desc="payloads") as bar:

        def report(done: int, total: int) -> None:
            bar.update(done - bar.n)

        make_payloads(
            assets, command.out, command.count, command.variants, command.seed, command.workers, command.making, report
        )
