"""A variant of a person: `primdiffusion vary`, and `vary` of JSON-RPC."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

from primdiffusion.commands.checks import check_attributes, check_seed
from primdiffusion.commands.edit import EditRequest, run_edit
from primdiffusion.commands.request import Attributes
from primdiffusion.editing.unit_interval import check_unit_interval
from primdiffusion.formats import requests

if TYPE_CHECKING:
    from primdiffusion.commands.edit import Sampling
    from primdiffusion.commands.session import Session
    from primdiffusion.human import Human


@dataclasses.dataclass(frozen=True, kw_only=True)
class VaryRequest(EditRequest):
    """Make a variant of a person: the same body, other clothes and face, by some noise and back."""

    amount: float = requests.AMOUNT
    """0: the person themselves; 1: hardly anything in common."""
    seed: int = 0
    """Which variant."""
    attributes: Attributes = dataclasses.field(default_factory=dict)
    """What they shall become, NAME=VALUE; `info` lists the names and values that a checkpoint knows."""
    guidance: float = requests.GUIDANCE
    """How strongly attributes are followed: 1 plainly, more at the cost of variety."""

    def check(self) -> None:
        """See `Request`."""
        super().check()
        check_unit_interval("amount", self.amount)
        check_seed(self.seed)
        check_attributes(self.attributes, self.guidance)

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """See `editing.vary`."""
        # torch is loaded late
        from primdiffusion.editing.edit import with_payload
        from primdiffusion.editing.vary import vary

        model = session.model(self.checkpoint)
        with sampling(lambda x0: with_payload(model, human, x0)) as on_step:
            return vary(model, human, self.amount, self.seed, self.steps, on_step, self.attributes, self.guidance)


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    run_edit(VaryRequest, arguments, "vary")
