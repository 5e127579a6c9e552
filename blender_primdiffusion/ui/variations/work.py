"""Many people at once, as the child is asked for them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from ..jobs.work import Work, chosen_checkpoint
from .icons import icons
from .sheet import sheet

PICTURE_PX = 256


@dataclasses.dataclass(frozen=True)
class VariationsWork(Work):
    """Show Variations, and More Like This."""

    kind = method = "variations"

    seeds: tuple[int, ...]
    steps: int
    sampler: str
    asked: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """attributes and guidance, where something is asked for."""
    person: str = ""
    """The backend's file of whom to vary; empty: new people."""
    amount: float = 0.5
    title: str = "New people"
    checkpoint: str = dataclasses.field(default_factory=lambda: chosen_checkpoint("checkpoint"))

    @property
    def label(self) -> str:
        """For people."""
        return f"{len(self.seeds)} Variations"

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method variations."""
        params: dict[str, Any] = {"seeds": list(self.seeds), "steps": self.steps, "sampler": self.sampler, **self.asked}
        if self.person:
            if not Path(self.person).is_file():
                raise FileNotFoundError("the person to vary was cleared meanwhile: show variations again")
            params |= {"person": self.person, "amount": self.amount}
        if self.checkpoint:
            params["checkpoint"] = self.checkpoint
        return {**params, "size": PICTURE_PX, "out_dir": str(folder)}

    def finish(self, _context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Put them on the sheet; the scene stays as it is."""
        sheet.fill(result["people"], self.title, around=bool(self.person))
        icons.free()  # those of the steps
        return f"{len(self.seeds)} people in {result['seconds']:.1f} s"
