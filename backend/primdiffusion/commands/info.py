"""What an installation, a checkpoint or a person is: `primdiffusion info`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import tyro

from primdiffusion import __version__
from primdiffusion.commands.request import parse


@dataclasses.dataclass(frozen=True)
class InfoCommand:
    """Say what this installation, a checkpoint or a person is, as JSON."""

    file: tyro.conf.Positional[Path | None] = None
    """A .human.safetensors, a checkpoint or an encoder; without it versions, device, memory and the package's cards."""

    def check(self) -> None:
        """See `Request`."""

    def show(self) -> None:
        """Prints one JSON object."""
        import torch  # late

        from primdiffusion.diffusion.checkpoint import default_checkpoint, read_card
        from primdiffusion.encoder.checkpoint import default_encoder

        # torch is loaded late
        from primdiffusion.human_file import NoPersonError, format_version, load_human
        from primdiffusion.machine import best_device, device_info, memory

        if self.file is None:
            cards = {
                name: read_card(path) if path.exists() else None
                for name, path in (("checkpoint", default_checkpoint()), ("encoder", default_encoder()))
            }
            about = {"version": __version__, "torch": torch.__version__, **device_info(best_device()), **memory()}
            print(json.dumps({**about, **cards}, indent=2))
            return
        try:
            human = load_human(self.file)
        except NoPersonError:
            print(json.dumps(dict(read_card(self.file)), indent=2))
        else:
            betas = [round(beta, 4) for beta in human.betas.tolist()]
            body = "default" if human.body_setup is None else dataclasses.asdict(human.body_setup.files)
            about = {"format_version": format_version(human), **human.provenance, "betas": betas, "body": body}
            print(json.dumps(about, indent=2))


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    parse(InfoCommand, arguments, "info").show()
