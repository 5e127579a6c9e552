"""The command `primdiffusion payloads`: people as primitives, from meshes or captures; packed into shards."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import tyro
from tqdm import tqdm

PROG = "primdiffusion payloads"


@dataclasses.dataclass(frozen=True)
class EncodePayloads:
    """Make captured people into training payloads: what the frozen encoder sees in their pictures.

    Captures are those of `primdiffusion captures`, of Blender's Render Captures, or a dataset in the released code's
    layout. The same line again makes what is missing.
    """

    captures: Path
    """Folder of a dataset of captures."""
    out: Path
    """Folder to write NAME.npz into."""
    encoder: Path | None = None
    """Trained encoder (.safetensors); without it the one that comes with the package."""
    people: Path | None = None
    """Folder of `primdiffusion people` that the captures show: tells their outfits, hair, height and so on."""
    views: int = 8
    """Pictures that the encoder is given, spread around the person; all where there are fewer."""
    looks: int = 1
    """Frames of each person, evenly spaced, of each of which a payload is made; the first, near T, hides least."""
    refine_steps: int = 0
    """Steps of refinement on all pictures of the person, which show what the encoder blurs; 300 do well. 0: none."""
    refine_size: int = 256
    """Pixels a side, at most, of the pictures that are refined on."""
    seed: int = 0
    """Of the order of pictures in refining."""

    def run(self) -> None:
        """Encodes, and prints what became of everybody.

        Raises:
            ValueError, FileNotFoundError: captures or encoder are missing or damaged; somebody failed; OSError.
        """
        from primdiffusion.capture.reader import open_captures
        from primdiffusion.encoder.checkpoint import load_encoder
        from primdiffusion.machine import best_device
        from primdiffusion.training.captured_people import EncodeSettings, encode_people, read_cards

        settings = EncodeSettings(self.views, self.looks, self.refine_steps, self.refine_size, self.seed)
        captures = open_captures(self.captures)
        cards = {} if self.people is None else read_cards(self.people)
        model = load_encoder(self.encoder, best_device())
        outcomes = Counter()
        work = encode_people(model, captures, self.out, settings, cards)
        for outcome in tqdm(work, total=len(captures.subjects), unit="person", disable=None):
            outcomes[outcome.what] += 1
            unknown = self.people is not None and outcome.subject not in cards
            told = outcome.why or ("their attributes are not known" if unknown else "")
            print(f"{outcome.subject}  {outcome.what}  {told}".rstrip(), flush=True)
        if outcomes["failed"]:
            raise ValueError(f"{outcomes['failed']} of {len(captures.subjects)} people failed: see the lines above")


@dataclasses.dataclass(frozen=True)
class PackPayloads:
    """Store people in few files with checksums, which training maps into memory: large, but quick to read."""

    folder: tyro.conf.Positional[Path]
    """Folder of people, a file each."""
    out: Path
    """Folder to write shards and their index into: `primdiffusion train --data` takes it."""
    people_each: int = 32
    """People a shard; one of four colourings takes 8 MiB."""

    def run(self) -> None:
        """Packs, and prints the folder."""
        from primdiffusion.training.shards import pack_people
        from primdiffusion.training.stored_people import find_people

        done = 0
        with tqdm(total=len(find_people(self.folder)), unit="person", desc="pack", disable=None) as bar:
            for done in pack_people(self.folder, self.out, self.people_each):
                bar.update(done - bar.n)
        print(f"{self.out}  {done} people")


@dataclasses.dataclass(frozen=True)
class VerifyPayloads:
    """Compare packed people with their checksums."""

    folder: tyro.conf.Positional[Path]
    """Folder of shards."""

    def run(self) -> None:
        """Prints a line for each shard that is damaged. Raises ValueError where one is."""
        from primdiffusion.training.shards import damaged_shards

        found = damaged_shards(self.folder)
        for sentence in found:
            print(sentence)
        if found:
            raise ValueError(f"{len(found)} shards of {self.folder} are damaged: pack the people again")
        print(f"{self.folder}: nothing wrong")


COMMANDS = {"encode": EncodePayloads, "pack": PackPayloads, "verify": VerifyPayloads}


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions; without one of COMMANDS it makes people from an asset folder."""
    if arguments and arguments[0] in COMMANDS:
        name = arguments[0]
        tyro.cli(COMMANDS[name], args=arguments[1:], prog=f"{PROG} {name}").run()
        return
    from primdiffusion.people.command import PayloadsCommand, run_payloads

    run_payloads(tyro.cli(PayloadsCommand, args=arguments, prog=PROG))
