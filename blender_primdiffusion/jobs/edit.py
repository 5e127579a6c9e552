"""Jobs that change a human in place: edits."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..backend.requests import sentence
from ..formats.answers import HumanAnswer
from ..scene.cycles import overlap_warning_in
from ..scene.edit import Replaced, replace_person
from ..scene.payload import session_file
from ..scene.representation import in_viewport, representation_of
from ..scene.volume_nodes import set_folder
from ..scene.volumes import free_unused_grids
from .queue import PREVIEW_PX, Job, chosen_checkpoint
from .target import HumanTarget
from .volumes import write_or_report

_STEP_PICTURE_PX = 256
"""Of the picture after each step, for the panel."""


def show_in_place(context: bpy.types.Context, person: bpy.types.Object, result: HumanAnswer) -> Replaced:
    """Show the human of the child's `result` in place of `person`. Raises as `replace_person` does."""
    done = replace_person(person, result.person)
    if representation_of(person) == "VOLUMES" and in_viewport(person):
        write_or_report(person)
        set_folder(person, session_file(person).parent, again=True)
        context.view_layer.update()  # evaluated data holds the old grids
        free_unused_grids()
    return done


_EDITS = {
    "vary": ("Vary Human", "Varied"),
    "inpaint": ("Regenerate Region", "Re-dressed"),
    "transfer": ("Transfer Texture", "Texture transferred to"),
    "interpolate": ("Blend Humans", "Blended"),
}
"""By the child's method: the undo step, and what stands before the human's name in the message."""


@dataclasses.dataclass
class EditJob(Job):
    """Change a human in place: vary it, generate a region again, transfer one from another human, or blend the two."""

    method: str
    target: HumanTarget
    asked: Mapping[str, Any]
    """Fields of the request. A region {"painted": [V numbers]} holds weights, and travels as a file."""
    checkpoint: str = dataclasses.field(default_factory=lambda: chosen_checkpoint("checkpoint"))

    @classmethod
    def of(cls, method: str, person: bpy.types.Object, asked: Mapping[str, Any]) -> EditJob:
        """Raises ValueError for a human that cannot be edited."""
        session_file(person)
        return cls(method, HumanTarget.of(person), asked)

    def __post_init__(self) -> None:
        self.kind = self.method
        self.undo, self.made = _EDITS[self.method]

    @property
    def label(self) -> str:
        return f"{self.undo}: {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        asked = dict(self.asked)
        if isinstance(asked.get("region"), Mapping):
            painted = asked.pop("region")["painted"]
            np.savez(folder / "region.npz", weights=np.asarray(painted, np.float32))
            asked["weights"] = str(folder / "region.npz")
        checkpoint = {"checkpoint": self.checkpoint} if self.checkpoint else {}
        previews = {"size": PREVIEW_PX, "picture_px": _STEP_PICTURE_PX}
        return {**asked, "person": self.target.file_now(), **previews, **checkpoint, "out_dir": str(folder)}

    def finish(self, context: bpy.types.Context, result: HumanAnswer, _folder: Path) -> str:
        person = self.target.found()
        done = show_in_place(context, person, result)
        shape = "; the body's shape has changed too" if done.reshaped else ""
        message = f"{self.made} {person.name} in {result.seconds:.1f} s"
        warnings = (*result.warnings, done.warning, overlap_warning_in(context.scene, person))
        return " ".join([f"{message}{shape}.", *(sentence(text) for text in warnings if text)])
