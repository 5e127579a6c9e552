"""Training data: `primdiffusion people`, meshes to render; `primdiffusion payloads`, primitives to train on."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import tyro
from tqdm import tqdm

from primdiffusion.formats.requests import Making


@dataclasses.dataclass(frozen=True)
class MakePeople:
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

    def run(self) -> None:
        """Make the humans, show progress, and print the folder. Raises ValueError, FileNotFoundError, OSError."""
        # torch is loaded late
        from primdiffusion.people.assets import open_assets
        from primdiffusion.people.folder import PeopleSet, make_people, unknown_licences
        from primdiffusion.people.wardrobe import required_meshes

        people = PeopleSet(self.out, self.seed, self.count)
        assets = open_assets(self.assets, required_meshes())
        with tqdm(total=self.count, unit="human", desc="people", disable=None) as bar:
            for done in make_people(assets, people, self.workers):
                bar.update(done - bar.n)
        unknown = unknown_licences(self.out)
        if unknown:
            print(
                f"primdiffusion: {len(unknown)} asset files state no licence ({unknown[0]}, ...), so the manifest "
                "lists it as unknown: list them in a LICENSES.txt beside the asset folder",
                file=sys.stderr,
            )
        print(self.out)


@dataclasses.dataclass(frozen=True)
class MakePayloads:
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

    def run(self) -> None:
        """Make the payloads and show progress. Raises ValueError, FileNotFoundError, OSError."""
        # torch is loaded late
        from primdiffusion.people.assets import open_assets
        from primdiffusion.people.payloads import make_payloads
        from primdiffusion.people.wardrobe import required_meshes

        assets = open_assets(self.assets, required_meshes())
        with tqdm(total=self.count, unit="human", desc="payloads") as bar:

            def report(done: int, total: int) -> None:
                bar.update(done - bar.n)

            make_payloads(assets, self.out, self.count, self.variants, self.seed, self.workers, self.making, report)


@dataclasses.dataclass(frozen=True)
class EncodePayloads:
    """Encode captures as training payloads with the trained encoder.

    Captures are those of `primdiffusion captures`, of Blender's Render Captures, or a dataset in the released code's
    layout. Running the command again resumes it.
    """

    captures: Path
    """Folder of a capture dataset."""
    out: Path
    """Output folder of NAME.npz."""
    encoder: Path | None = None
    """Trained encoder (.safetensors); the default is the one in the package."""
    people: Path | None = None
    """Folder of `primdiffusion people` that was captured, for attributes such as outfit, hair and height."""
    views: int = 8
    """Images to encode, spread around the subject; all if there are fewer."""
    looks: int = 1
    """Frames of each subject to encode, evenly spaced; the first, near the T pose, has the least occlusion."""
    refine_steps: int = 0
    """Refinement steps on all images of the subject, which restore detail that the encoder blurs, such as 300; 0 for
    none."""
    refine_size: int = 256
    """Largest side of the images used in refinement, pixels."""
    seed: int = 0
    """Seed of the order of images in refinement."""

    def run(self) -> None:
        """Encode, and print a line for each subject.

        Raises:
            ValueError, FileNotFoundError: captures or encoder are missing or damaged, or a subject failed; OSError.
        """
        # torch is loaded late
        from primdiffusion.capture.reader import open_captures
        from primdiffusion.encoder.model import load_encoder
        from primdiffusion.machine import best_device
        from primdiffusion.training.captured_people import EncodeSettings, encode_people, read_cards

        settings = EncodeSettings(self.views, self.looks, self.refine_steps, self.refine_size, self.seed)
        captures = open_captures(self.captures)
        cards = {} if self.people is None else read_cards(self.people)
        model = load_encoder(self.encoder, best_device())
        outcomes = Counter()
        work = encode_people(model, captures, self.out, settings, cards)
        for outcome in tqdm(work, total=len(captures.subjects), unit="human", disable=None):
            outcomes[outcome.status] += 1
            unknown = self.people is not None and outcome.subject not in cards
            note = outcome.error or ("attributes unknown" if unknown else "")
            print(f"{outcome.subject}  {outcome.status}  {note}".rstrip(), flush=True)
        if outcomes["failed"]:
            raise ValueError(f"{outcomes['failed']} of {len(captures.subjects)} humans failed: see the lines above")


@dataclasses.dataclass(frozen=True)
class PackPayloads:
    """Pack payloads into a few files with checksums that training maps into memory: large, but quick to read."""

    folder: tyro.conf.Positional[Path]
    """Folder of payloads, one file each."""
    out: Path
    """Output folder of shards and their index, for `primdiffusion train --data`."""
    people_each: int = 32
    """Payloads in a shard; one with four colour variants takes 8 MiB."""

    def run(self) -> None:
        """Pack, and print the folder."""
        # torch is loaded late
        from primdiffusion.training.shards import pack_people
        from primdiffusion.training.stored_people import find_people

        done = 0
        with tqdm(total=len(find_people(self.folder)), unit="human", desc="pack", disable=None) as bar:
            for done in pack_people(self.folder, self.out, self.people_each):
                bar.update(done - bar.n)
        print(f"{self.out}  {done} humans")


@dataclasses.dataclass(frozen=True)
class VerifyPayloads:
    """Verify the checksums of packed payloads."""

    folder: tyro.conf.Positional[Path]
    """Folder of shards."""

    def run(self) -> None:
        """Print a line for each damaged shard; raises ValueError if there is any."""
        from primdiffusion.training.shards import damaged_shards  # torch is loaded late

        found = damaged_shards(self.folder)
        for sentence in found:
            print(sentence)
        if found:
            raise ValueError(f"{len(found)} shards of {self.folder} are damaged: pack the humans again")
        print(f"{self.folder}: nothing wrong")


PAYLOADS_COMMANDS = {"encode": EncodePayloads, "pack": PackPayloads, "verify": VerifyPayloads}


def run_people(arguments: Sequence[str]) -> None:
    """Run a command line of `people`; raises its errors."""
    tyro.cli(MakePeople, args=arguments, prog="primdiffusion people").run()


def run_payloads(arguments: Sequence[str]) -> None:
    """Run a command line of `payloads`, with or without one of PAYLOADS_COMMANDS; raises its errors."""
    command, prog = MakePayloads, "primdiffusion payloads"
    if arguments and arguments[0] in PAYLOADS_COMMANDS:
        command, prog = PAYLOADS_COMMANDS[arguments[0]], f"{prog} {arguments[0]}"
        arguments = arguments[1:]
    tyro.cli(command, args=arguments, prog=prog).run()
