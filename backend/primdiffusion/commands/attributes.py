"""What a checkpoint can be asked for: `attributes` of JSON-RPC."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from primdiffusion.commands.progress import Report

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session


@dataclasses.dataclass(frozen=True)
class AttributesRequest:
    """Values of categories, mean and standard deviation of scalars."""

    checkpoint: Path | None = None
    """Trained model (.safetensors); without it the one that comes with the package."""

    def check(self) -> None:
        """See `Request`."""

    def run(self, session: Session, report: Report) -> dict[str, Any]:
        """Raises what read_card does."""
        # torch is loaded late
        from primdiffusion.diffusion.checkpoint import read_card
        from primdiffusion.diffusion.conditioning import NOTHING

        return read_card(self.checkpoint).get("attributes", NOTHING.to_json())
