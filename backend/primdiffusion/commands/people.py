"""Training data: `primdiffusion people`, meshes to render; `primdiffusion payloads`, primitives to train on."""

from __future__ import annotations

from pathlib import Path

from primdiffusion.capture.reader import open_captures
from primdiffusion.commands.options import (
    EncodePayloadsCommand,
    PayloadsCommand,
    PeopleCommand,
)
from primdiffusion.commands.progress import ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.files.regular_files import printable
from primdiffusion.people.assets import open_assets
from primdiffusion.people.folder import PeopleSet, make_people
from primdiffusion.people.payloads import make_payloads
from primdiffusion.people.wardrobe import required_meshes
from primdiffusion.runtime.worker_process import lock_folder
from primdiffusion.training.captured_people import encode_people, read_cards


def people(command: PeopleCommand, session: Session, report: ReportProgress) -> Path:
    """Make the humans; return the folder. Raises ValueError, FileNotFoundError, OSError."""
    wanted = PeopleSet(command.out, command.seed, command.count)
    assets = open_assets(command.assets, required_meshes())
    with lock_folder(command.out):
        for done in make_people(assets, wanted, command.workers):
            report("people", done, command.count, None)
    return command.out


def payloads(command: PayloadsCommand, session: Session, report: ReportProgress) -> None:
    """Make the payloads. Raises ValueError, FileNotFoundError, OSError."""
    make_payloads(
        open_assets(command.assets, required_meshes()),
        command.out,
        command.count,
        command.variants,
        command.seed,
        command.workers,
        command.checkpoint,
        lambda done, total: report("payloads", done, total, None),
    )


def encode(command: EncodePayloadsCommand, session: Session, report: ReportProgress) -> None:
    """Encode, and print a line for each subject.

    Raises:
        ValueError, FileNotFoundError: captures or encoder are missing or damaged, or a subject failed; OSError.
    """
    captures = open_captures(command.captures)
    cards = {} if command.people is None else read_cards(command.people)
    model = session.encoder(command.encoder)
    failed, total = 0, len(captures.subjects)
    with lock_folder(command.out):
        for done, outcome in enumerate(encode_people(model, captures, command.out, command, cards), 1):
            failed += outcome.status == "failed"
            unknown = command.people is not None and outcome.subject not in cards
            note = outcome.error or ("attributes unknown" if unknown else "")
            print(printable(f"{outcome.subject}  {outcome.status}  {note}").rstrip(), flush=True)
            report("encode", done, total, None)
    if failed:
        raise ValueError(f"{failed} of {total} humans failed: see the lines above")
