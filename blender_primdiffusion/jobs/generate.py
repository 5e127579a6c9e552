"""Jobs that add a new human to the scene: from noise, or from captures."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from ..backend.requests import sentence
from ..formats.answers import HumanAnswer
from ..formats.requests import ReconstructRequest
from ..scene.build import build_human
from ..scene.cycles import overlap_warning_in
from ..scene.edit import select_human
from ..scene.human import humans
from ..scene.place import stand_at_cursor
from .queue import PREVIEW_PX, Job, chosen_checkpoint
from .views import bring_into_view

FIRST_HUMAN_SHARE = 0.25
"""Of a view's height: a scene's first human is framed where no view shows it taller."""


def build_person(
    context: bpy.types.Context, result: HumanAnswer, made: str, name: str = "Human"
) -> tuple[bpy.types.Object, str]:
    """Build the human of the child's `result`; returns them and the message ("Generated in 1.2 s.").

    Raises as `build_human` does, and then leaves nothing.
    """
    began = time.monotonic()
    person = build_human(context, result.person, name)
    stand_at_cursor(context, person)
    if context.mode == "OBJECT":  # else the user is posing or painting
        select_human(context, person)
        bring_into_view(person, 0.0 if len(humans(context.scene)) > 1 else FIRST_HUMAN_SHARE)
    warnings = list(result.warnings)
    if overlap := overlap_warning_in(context.scene, person):
        warnings.append(overlap)
    notice = f"{made} in {result.seconds + time.monotonic() - began:.1f} s"
    return person, " ".join([sentence(notice), *map(sentence, warnings)])


_STEP_PICTURE_PX = 256
"""Of the picture after each step, for the panel."""


@dataclasses.dataclass(frozen=True)
class GenerateJob(Job):
    """Generate Human."""

    kind = method = "generate"
    undo = "Generate Human"

    seed: int
    sampling: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Other fields of `GenerateRequest`: steps, sampler, attributes, guidance."""
    checkpoint: str = dataclasses.field(default_factory=lambda: chosen_checkpoint("checkpoint"))
    next_seed: int | None = None
    """What the panel's seed becomes with this human; None where it was not used, or is locked."""

    @property
    def label(self) -> str:
        return f"Human, seed {self.seed}"

    def params(self, folder: Path) -> dict[str, Any]:
        checkpoint = {"checkpoint": self.checkpoint} if self.checkpoint else {}
        previews = {"size": PREVIEW_PX, "picture_px": _STEP_PICTURE_PX}
        return {"seed": self.seed, **self.sampling, **previews, **checkpoint, "out_dir": str(folder)}

    def finish(self, context: bpy.types.Context, result: HumanAnswer, _folder: Path) -> str:
        notice = build_person(context, result, "Generated")[1]
        if self.next_seed is not None:
            context.scene.primdiffusion.seed = self.next_seed
        return notice


@dataclasses.dataclass(frozen=True)
class ReconstructJob(Job):
    """Human from Captures."""

    kind = method = "reconstruct"
    undo = "Human from Captures"

    capture: str
    """Folder of a dataset of captures, or of one subject in it."""
    subject: str
    """Empty for the only one."""
    frame: int
    views: int
    by: str = ReconstructRequest.by

    @property
    def label(self) -> str:
        return f"Human from Captures, {self.subject or Path(self.capture).name}"

    def params(self, folder: Path) -> dict[str, Any]:
        params: dict[str, Any] = {"capture": self.capture, "frame": self.frame, "views": self.views, "by": self.by}
        checkpoint = chosen_checkpoint("encoder" if self.by == "encoder" else "checkpoint")
        optional = {"subject": self.subject, "checkpoint": checkpoint}
        return {**params, **{k: v for k, v in optional.items() if v}, "out_dir": str(folder)}

    def finish(self, context: bpy.types.Context, result: HumanAnswer, _folder: Path) -> str:
        return build_person(context, result, "Reconstructed")[1]
