"""A region of a person made anew: `primdiffusion inpaint`, and `inpaint` of JSON-RPC."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

from primdiffusion.commands.checks import check_attributes, check_seed
from primdiffusion.commands.edit import EditRequest, RegionArgument, guess_inside, run_edit
from primdiffusion.commands.request import Attributes
from primdiffusion.formats import requests

if TYPE_CHECKING:
    from primdiffusion.commands.edit import Sampling
    from primdiffusion.commands.session import Session
    from primdiffusion.human import Human


@dataclasses.dataclass(frozen=True, kw_only=True)
class InpaintRequest(EditRequest):
    """Make a region of a person anew, so that it fits the rest: re-dress them, or give them other hair."""

    region: RegionArgument
    seed: int = 0
    """Which of the possible results."""
    attributes: Attributes = dataclasses.field(default_factory=dict)
    """What the region shall become, NAME=VALUE as in outfit=suit; `info` lists what a checkpoint knows."""
    guidance: float = requests.GUIDANCE
    """How strongly attributes are followed: 1 plainly, more at the cost of variety."""

    def check(self) -> None:
        """See `Request`."""
        super().check()
        self.region.check()
        check_seed(self.seed)
        check_attributes(self.attributes, self.guidance)

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """See `editing.inpaint`."""
        from primdiffusion.editing.inpaint import inpaint  # torch is loaded late

        region = self.region.primitives(human)
        model = session.model(self.checkpoint)
        with sampling(lambda x0: guess_inside(model, human, region, x0)) as on_step:
            return inpaint(model, human, region, self.seed, self.steps, self.attributes, self.guidance, on_step)


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    run_edit(InpaintRequest, arguments, "inpaint")
