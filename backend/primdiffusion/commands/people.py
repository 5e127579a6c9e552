"""Training data: `primdiffusion people`, meshes to render; `primdiffusion payloads`, primitives to train on."""

from __future__ import annotations

import sys
from collections import Counter

from tqdm import tqdm

from primdiffusion.capture.reader import open_captures
from primdiffusion.commands.options import (
    EncodePayloadsCommand,
    PackPayloadsCommand,
    PayloadsCommand,
    PeopleCommand,
    VerifyPayloadsCommand,
)
from primdiffusion.encoder.model import load_encoder
from primdiffusion.files.folder_lock import lock_folder
from primdiffusion.files.regular_files import printable
from primdiffusion.people.assets import open_assets
from primdiffusion.people.folder import PeopleSet, make_people, unknown_licences
from primdiffusion.people.payloads import make_payloads
from primdiffusion.people.wardrobe import required_meshes
from primdiffusion.runtime.device import best_device
from primdiffusion.training.captured_people import EncodeSettings, encode_people, read_cards
from primdiffusion.training.shards import damaged_shards, pack_people
from primdiffusion.training.stored_people import find_people


def run_people(command: PeopleCommand) -> None:
    """Make the humans, show progress, and print the folder. Raises ValueError, FileNotFoundError, OSError."""
    people = PeopleSet(command.out, command.seed, command.count)
    assets = open_assets(command.assets, required_meshes())
    with lock_folder(command.out), tqdm(total=command.count, unit="human", desc="people", disable=None) as bar:
        for done in make_people(assets, people, command.workers):
            bar.update(done - bar.n)
    unknown = unknown_licences(command.out)
    if unknown:
        print(
            f"primdiffusion: {len(unknown)} asset files state no licence ({printable(unknown[0])}, ...), so the "
            "manifest lists it as unknown: list them in a LICENSES.txt beside the asset folder",
            file=sys.stderr,
        )
    print(command.out)


def run_payloads(command: PayloadsCommand) -> None:
    """Make the payloads and show progress. Raises ValueError, FileNotFoundError, OSError."""
    assets = open_assets(command.assets, required_meshes())
    with tqdm(total=command.count, unit="human", desc="payloads") as bar:

        def report(done: int, total: int) -> None:
            bar.update(done - bar.n)

        make_payloads(
            assets,
            command.out,
            command.count,
            command.variants,
            command.seed,
            command.workers,
            command.making,
            command.checkpoint,
            report,
        )


def run_encode(command: EncodePayloadsCommand) -> None:
    """Encode, and print a line for each subject.

    Raises:
        ValueError, FileNotFoundError: captures or encoder are missing or damaged, or a subject failed; OSError.
    """
    settings = EncodeSettings(command.views, command.looks, command.refine_steps, command.refine_size, command.seed)
    captures = open_captures(command.captures)
    cards = {} if command.people is None else read_cards(command.people)
    model = load_encoder(command.encoder, best_device())
    outcomes = Counter()
    work = encode_people(model, captures, command.out, settings, cards)
    with lock_folder(command.out):
        for outcome in tqdm(work, total=len(captures.subjects), unit="human", disable=None):
            outcomes[outcome.status] += 1
            unknown = command.people is not None and outcome.subject not in cards
            note = outcome.error or ("attributes unknown" if unknown else "")
            print(printable(f"{outcome.subject}  {outcome.status}  {note}").rstrip(), flush=True)
    if outcomes["failed"]:
        raise ValueError(f"{outcomes['failed']} of {len(captures.subjects)} humans failed: see the lines above")


def run_pack(command: PackPayloadsCommand) -> None:
    """Pack, and print the folder."""
    done = 0
    with tqdm(total=len(find_people(command.folder)), unit="human", desc="pack", disable=None) as bar:
        for done in pack_people(command.folder, command.out, command.people_each):
            bar.update(done - bar.n)
    print(f"{command.out}  {done} humans")


def run_verify(command: VerifyPayloadsCommand) -> None:
    """Print a line for each damaged shard; raises ValueError if there is any."""
    found = damaged_shards(command.folder)
    for sentence in found:
        print(printable(sentence))
    if found:
        raise ValueError(f"{len(found)} shards of {command.folder} are damaged: pack the humans again")
    print(f"{command.folder}: nothing wrong")
