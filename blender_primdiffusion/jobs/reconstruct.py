"""A person from captures, as the child is asked for it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import bpy

from .job import Job, chosen_checkpoint
from .person import build_person


@dataclasses.dataclass(frozen=True)
class ReconstructJob(Job):
    """Human from Captures."""

    kind = method = "reconstruct"
    undo = "Human from Captures"
    new_person = "Human"

    capture: str
    """Folder of a dataset of captures, or of one subject in it."""
    subject: str
    """Empty: the only one."""
    frame: int
    views: int
    checkpoint: str = dataclasses.field(default_factory=lambda: chosen_checkpoint("encoder"))

    @property
    def label(self) -> str:
        """For people."""
        return f"Human from Captures, {self.subject or Path(self.capture).name}"

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method reconstruct."""
        params: dict[str, Any] = {"capture": self.capture, "frame": self.frame, "views": self.views}
        optional = {"subject": self.subject, "checkpoint": self.checkpoint}
        return {**params, **{k: v for k, v in optional.items() if v}, "out_dir": str(folder)}

    def finish(self, context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Build the person."""
        return build_person(context, result, "Reconstructed")[1]
