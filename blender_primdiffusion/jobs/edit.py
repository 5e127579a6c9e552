"""A person made of one in the scene, in place, as the child is asked for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import bpy
import numpy as np

from ..scene.edit import edit_destination
from ..scene.files import person_file
from ..scene.overlap import overlap_warning_in
from ..scene.writing import Destination
from ..worker.sentence import sentence
from .job import Job, chosen_checkpoint
from .person import show_in_place
from .target import Target

_PICTURE_PX = 16
"""The child's pictures of the finished person are of no use here."""
_STEP_PICTURE_PX = 256
"""Of the person so far, for the panel."""


@dataclasses.dataclass(frozen=True)
class EditJob(Job):
    """What the edits have in common."""

    made: ClassVar[str]
    """What became of the person, for the news."""

    target: Target
    steps: int
    asked: Mapping[str, Any]
    """The method's other parameters. A region {"painted": [V numbers]} holds weights, and travels as a file."""
    checkpoint: str = dataclasses.field(default_factory=lambda: chosen_checkpoint("checkpoint"))

    @classmethod
    def of(cls, person: bpy.types.Collection, steps: int, asked: Mapping[str, Any]) -> EditJob:
        """Raises ValueError for a person that cannot be edited, FileNotFoundError for one whose file is missing."""
        person_file(person)
        return cls(Target.of(person), steps, asked)

    @property
    def label(self) -> str:
        """For people."""
        return f"{self.undo}: {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method."""
        asked = dict(self.asked)
        if isinstance(asked.get("region"), Mapping):
            np.savez(folder / "region.npz", weights=np.asarray(asked["region"]["painted"], np.float32))
            asked["region"] = {"weights": str(folder / "region.npz")}
        checkpoint = {"checkpoint": self.checkpoint} if self.checkpoint else {}
        params = {**asked, "person": self.target.file_now(), "steps": self.steps, "size": _PICTURE_PX}
        params["picture_px"] = _STEP_PICTURE_PX
        return {**params, **checkpoint, "out_dir": str(folder)}

    def place(self) -> Destination:
        """In the place of the person's own."""
        return edit_destination(self.target.found())

    def finish(self, context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Show the edited person in the place of the one that was; in which scene does not matter."""
        person = self.target.found()
        done = show_in_place(context, person, result)
        shape = ", the body's shape too" if done.reshaped else ""
        news = f"{self.made} in {result['seconds']:.1f} s; {done.volumes} of {done.of} volumes of {person.name} changed"
        warnings = (*result.get("warnings", ()), done.warning, overlap_warning_in(context.scene, person))
        return " ".join([f"{news}{shape}.", *(sentence(text) for text in warnings if text)])


class VaryJob(EditJob):
    """Vary."""

    kind = method = "vary"
    undo, made = "Vary Human", "Varied"


class RedressJob(EditJob):
    """Re-dress Region."""

    kind = method = "inpaint"
    undo, made = "Re-dress Region", "Re-dressed"


class TransferJob(EditJob):
    """Transfer Texture."""

    kind = method = "transfer"
    undo, made = "Transfer Texture", "Texture transferred"


class BlendJob(EditJob):
    """Blend."""

    kind = method = "interpolate"
    undo, made = "Blend Humans", "Blended"
