"""Describe an installation, a checkpoint or a human: `info` and `attributes`."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from primdiffusion.commands.options import InfoCommand
from primdiffusion.commands.progress import ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.checkpoint import default_checkpoint, read_card
from primdiffusion.diffusion.conditioning import NOTHING
from primdiffusion.encoder.model import default_encoder
from primdiffusion.formats.answers import AttributesAnswer
from primdiffusion.formats.requests import AttributesRequest
from primdiffusion.human_file import NoPersonError, format_version, load_human
from primdiffusion.runtime.machine import memory
from primdiffusion.version import __version__


def info(command: InfoCommand, session: Session, report: ReportProgress) -> str:
    """Return one JSON object."""
    if command.file is None:
        about = _installation(session)
    else:
        try:
            human = load_human(command.file)
        except NoPersonError:
            about = read_card(command.file)
        else:
            betas = [round(beta, 4) for beta in human.betas.tolist()]
            body = "default" if human.body_setup is None else dataclasses.asdict(human.body_setup.files)
            about = {"format_version": format_version(human), **human.provenance, "betas": betas, "body": body}
    return json.dumps(about, indent=2)


def _installation(session: Session) -> dict[str, Any]:
    cards = {
        name: read_card(path) if path.exists() else None
        for name, path in (("checkpoint", default_checkpoint()), ("encoder", default_encoder()))
    }
    return {"version": __version__, **session.device_info(), **memory(), **cards}


def attributes(request: AttributesRequest, session: Session, report: ReportProgress) -> AttributesAnswer:
    """Raises as read_card."""
    return AttributesAnswer(**read_card(request.checkpoint).get("attributes", NOTHING.to_json()))
