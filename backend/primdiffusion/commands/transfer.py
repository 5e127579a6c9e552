"""The looks of one person for a region of another: `primdiffusion transfer`, and `transfer` of JSON-RPC."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from primdiffusion.commands.checks import check_seed
from primdiffusion.commands.edit import EditRequest, RegionArgument, guess_inside, run_edit
from primdiffusion.editing.unit_interval import check_unit_interval
from primdiffusion.formats import requests

if TYPE_CHECKING:
    from primdiffusion.commands.edit import Sampling
    from primdiffusion.commands.session import Session
    from primdiffusion.human import Human


@dataclasses.dataclass(frozen=True, kw_only=True)
class TransferRequest(EditRequest):
    """Give a region of a person the looks of another one. Checkpoint, seed and steps are those of harmonising."""

    source: Path
    """A .human.safetensors file: whose looks."""
    region: RegionArgument
    what: requests.Transfer = requests.TRANSFERS[0]
    """texture: colours alone, on the person's own shape; garment: shape too, where the cut differs."""
    harmonise: float = 0.0
    """0 copies exactly; up to 1, how much the region is then denoised so as to fit the rest."""
    seed: int = 0
    """Which of the possible results."""

    def check(self) -> None:
        """See `Request`."""
        super().check()
        self.region.check()
        check_unit_interval("harmonise", self.harmonise)
        check_seed(self.seed)

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """See `editing.transfer`. Loads a model only for harmonising."""
        # torch is loaded late
        from primdiffusion.editing.inpaint import harmonise
        from primdiffusion.editing.transfer import transfer_garment, transfer_texture
        from primdiffusion.human_file import load_human

        source, region = load_human(self.source), self.region.primitives(human)
        edited = (transfer_garment if self.what == "garment" else transfer_texture)(source, human, region)
        if not self.harmonise:
            return edited
        model = session.model(self.checkpoint)
        with sampling(lambda x0: guess_inside(model, edited, region, x0)) as on_step:
            return harmonise(model, edited, region, self.harmonise, self.seed, self.steps, on_step)


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    run_edit(TransferRequest, arguments, "transfer")
