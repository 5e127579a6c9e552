"""The command `primdiffusion people`: make a training set from an asset folder."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from tqdm import tqdm

from primdiffusion.people.assets import open_assets
from primdiffusion.people.payloads import make_payloads
from primdiffusion.people.wardrobe import required_meshes


@dataclasses.dataclass(frozen=True)
class PeopleCommand:
    """Make dressed people as primitives: the training set of the diffusion model."""

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
    workers: int = os.cpu_count() or 1
    """Processes; each takes a core and about 1 GB."""


def run(command: PeopleCommand) -> None:
    """Make the people and show how far it is."""
    assets = open_assets(command.assets, required_meshes())
    with tqdm(total=command.count, unit="person", desc="people") as bar:

        def report(done: int, total: int) -> None:
            bar.update(done - bar.n)

        make_payloads(assets, command.out, command.count, command.variants, command.seed, command.workers, report)
