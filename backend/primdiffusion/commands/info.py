"""Describe an installation, a checkpoint or a human: `primdiffusion info`, and `attributes` of JSON-RPC."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from primdiffusion import __version__
from primdiffusion.commands.request import ReportProgress, parse
from primdiffusion.machine import best_device, device_info, memory

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session


@dataclasses.dataclass(frozen=True)
class InfoCommand:
    """Describe this installation, a checkpoint or a human, as JSON."""

    file: tyro.conf.Positional[Path | None] = None
    """A .human.safetensors, a checkpoint or an encoder; without it versions, device, memory and the package's cards."""

    def check(self) -> None:
        """See `RequestRecord`."""

    def show(self) -> None:
        """Print one JSON object."""
        # torch is loaded late
        from primdiffusion.diffusion.checkpoint import read_card
        from primdiffusion.human_file import NoPersonError, format_version, load_human

        if self.file is None:
            about = _installation()
        else:
            try:
                human = load_human(self.file)
            except NoPersonError:
                about = read_card(self.file)
            else:
                betas = [round(beta, 4) for beta in human.betas.tolist()]
                body = "default" if human.body_setup is None else dataclasses.asdict(human.body_setup.files)
                about = {"format_version": format_version(human), **human.provenance, "betas": betas, "body": body}
        print(json.dumps(about, indent=2))


def _installation() -> dict[str, Any]:
    import torch  # loaded late

    # torch is loaded late
    from primdiffusion.diffusion.checkpoint import default_checkpoint, read_card
    from primdiffusion.encoder.model import default_encoder

    cards = {
        name: read_card(path) if path.exists() else None
        for name, path in (("checkpoint", default_checkpoint()), ("encoder", default_encoder()))
    }
    return {"version": __version__, "torch": torch.__version__, **device_info(best_device()), **memory(), **cards}


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    parse(InfoCommand, arguments, "info").show()


@dataclasses.dataclass(frozen=True)
class AttributesRequest:
    """Return the attributes a model can be conditioned on: values of categories, mean and deviation of scalars."""

    checkpoint: Path | None = None
    """Trained model (.safetensors); the default is the one in the package."""

    def check(self) -> None:
        """See `RequestRecord`."""

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Raises as read_card."""
        # torch is loaded late
        from primdiffusion.diffusion.checkpoint import read_card
        from primdiffusion.diffusion.conditioning import NOTHING

        return read_card(self.checkpoint).get("attributes", NOTHING.to_json())
