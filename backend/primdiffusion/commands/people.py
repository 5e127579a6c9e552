"""Training data: `primdiffusion people`, meshes to render; `primdiffusion payloads`, primitives to train on."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import tyro
from tqdm import tqdm


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
        for outcome in tqdm(work, total=len(captures.subjects), unit="person", disable=None):
            outcomes[outcome.status] += 1
            unknown = self.people is not None and outcome.subject not in cards
            note = outcome.error or ("attributes unknown" if unknown else "")
            print(f"{outcome.subject}  {outcome.status}  {note}".rstrip(), flush=True)
        if outcomes["failed"]:
            raise ValueError(f"{outcomes['failed']} of {len(captures.subjects)} people failed: see the lines above")


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
        with tqdm(total=len(find_people(self.folder)), unit="person", desc="pack", disable=None) as bar:
            for done in pack_people(self.folder, self.out, self.people_each):
                bar.update(done - bar.n)
        print(f"{self.out}  {done} people")


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
            raise ValueError(f"{len(found)} shards of {self.folder} are damaged: pack the people again")
        print(f"{self.folder}: nothing wrong")


PAYLOADS_COMMANDS = {"encode": EncodePayloads, "pack": PackPayloads, "verify": VerifyPayloads}


def run_people(arguments: Sequence[str]) -> None:
    """Run a command line of `people`; raises its errors."""
    from primdiffusion.people import command  # slow to import, and not needed by `payloads encode`

    command.run_people(tyro.cli(command.PeopleCommand, args=arguments, prog="primdiffusion people"))


def run_payloads(arguments: Sequence[str]) -> None:
    """Run a command line of `payloads`, with or without one of PAYLOADS_COMMANDS; raises its errors."""
    prog = "primdiffusion payloads"
    if arguments and arguments[0] in PAYLOADS_COMMANDS:
        name = arguments[0]
        tyro.cli(PAYLOADS_COMMANDS[name], args=arguments[1:], prog=f"{prog} {name}").run()
        return
    from primdiffusion.people import command  # slow to import, and not needed by `payloads encode`

    command.run_payloads(tyro.cli(command.PayloadsCommand, args=arguments, prog=prog))
