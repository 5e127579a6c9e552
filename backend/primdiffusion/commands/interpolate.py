"""A person between two: `primdiffusion interpolate`, and `interpolate` of JSON-RPC."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from primdiffusion.commands.edit import EditRequest, run_edit
from primdiffusion.editing.unit_interval import check_unit_interval
from primdiffusion.formats import requests

if TYPE_CHECKING:
    from torch import Tensor

    from primdiffusion.commands.edit import Sampling
    from primdiffusion.commands.session import Session
    from primdiffusion.human import Human


@dataclasses.dataclass(frozen=True, kw_only=True)
class InterpolateRequest(EditRequest):
    """Make a person between two: a likely one all the way, with the body between theirs."""

    other: tyro.conf.Positional[Path]
    """A second .human.safetensors file."""
    fraction: float = requests.FRACTION
    """0: the first person, 1: the other one, exactly."""

    def check(self) -> None:
        """See `Request`."""
        super().check()
        check_unit_interval("fraction", self.fraction)
        if self.steps < 2:
            raise ValueError(f"{self.steps} steps were asked for: an interpolation takes 2 or more")

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """See `editing.interpolate`."""
        # torch is loaded late
        from primdiffusion.editing.edit import with_payload
        from primdiffusion.editing.interpolate import interpolate
        from primdiffusion.human_file import load_human

        other = load_human(self.other)
        model = session.model(self.checkpoint)

        def show(x0: Tensor) -> Human | None:
            ends_and_between = len(x0) == 3  # two on the way from the people to their noises
            return with_payload(model, human, x0[2:]) if ends_and_between else None

        with sampling(show) as on_step:
            return interpolate(model, human, other, self.fraction, self.steps, on_step)


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    run_edit(InterpolateRequest, arguments, "interpolate")
