"""A person from noise, as the child is asked for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from .job import Job, chosen_checkpoint
from .person import build_person
from .seeds import random_seed

_PICTURE_PX = 16
"""The child's pictures of the finished person are of no use here."""
_STEP_PICTURE_PX = 256
"""Of the person so far, for the panel."""


@dataclasses.dataclass(frozen=True)
class GenerateJob(Job):
    """Generate Human."""

    kind = method = "generate"
    undo = "Generate Human"
    new_person = "Human"

    seed: int
    steps: int
    sampler: str = "ddim"
    asked: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """attributes and guidance, where something is asked for."""
    checkpoint: str = dataclasses.field(default_factory=lambda: chosen_checkpoint("checkpoint"))
    renews_seed: bool = False
    """The panel's seed was used and is not locked: with this person it becomes another one."""

    @property
    def label(self) -> str:
        """For people."""
        return f"Human, seed {self.seed}"

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method generate."""
        params = {"seed": self.seed, "steps": self.steps, "sampler": self.sampler, **self.asked}
        params |= {"size": _PICTURE_PX, "picture_px": _STEP_PICTURE_PX}
        checkpoint = {"checkpoint": self.checkpoint} if self.checkpoint else {}
        return {**params, **checkpoint, "out_dir": str(folder)}

    def finish(self, context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Build the person."""
        notice = build_person(context, result, "Generated")[1]
        if self.renews_seed:
            context.scene.primdiffusion.seed = random_seed()
        return notice
