"""Jobs that change a human in place: edits, and a human generated again after its files were lost."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import bpy
import numpy as np

from ..backend.requests import sentence
from ..formats.answers import HumanAnswer
from ..formats.human_layout import provenance_of as made_of
from ..scene.attachment import in_viewport
from ..scene.blend_values import as_shown
from ..scene.cycles import overlap_warning_in
from ..scene.edit import Replaced, replace_person
from ..scene.human import person_file, provenance_of
from ..scene.human_file import read_tensors
from ..scene.pending import pending_of, write_pending
from ..scene.states import prepare_now
from ..scene.volumes import free_unused_grids
from .follow import building
from .missing_files import look
from .queue import PREVIEW_PX, Job, chosen_checkpoint
from .target import HumanTarget

_STEP_PICTURE_PX = 256
"""Of the picture after each step, for the panel."""


def show_in_place(context: bpy.types.Context, person: bpy.types.Collection, result: HumanAnswer) -> Replaced:
    """Show the human of the child's `result` in place of `person`. Raises as `replace_person` does."""
    prepared = building.take(result.person) or prepare_now(result.person, replaced=person)
    done = replace_person(person, prepared)
    if in_viewport(person):
        if (pending := pending_of(person)) is not None:  # of volumes that undo has brought back since
            for _ in write_pending(pending):
                pass
        context.view_layer.update()  # evaluated data holds the old grids
        free_unused_grids()
    return done


@dataclasses.dataclass(frozen=True)
class EditJob(Job):
    """Base of the edits."""

    made: ClassVar[str]
    """Before the human's name in the message: Varied."""

    target: HumanTarget
    asked: Mapping[str, Any]
    """Fields of the request. A region {"painted": [V numbers]} holds weights, and travels as a file."""
    checkpoint: str = dataclasses.field(default_factory=lambda: chosen_checkpoint("checkpoint"))

    @classmethod
    def of(cls, person: bpy.types.Collection, asked: Mapping[str, Any]) -> EditJob:
        """Raises ValueError for a human that cannot be edited, FileNotFoundError for one whose file is missing."""
        person_file(person)
        return cls(HumanTarget.of(person), asked)

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

    def replaced(self) -> bpy.types.Collection:
        return self.target.found()

    def finish(self, context: bpy.types.Context, result: HumanAnswer, _folder: Path) -> str:
        person = self.target.found()
        done = show_in_place(context, person, result)
        shape = "; the body's shape has changed too" if done.reshaped else ""
        message = f"{self.made} {person.name} in {result.seconds:.1f} s"
        warnings = (*result.warnings, done.warning, overlap_warning_in(context.scene, person))
        return " ".join([f"{message}{shape}.", *(sentence(text) for text in warnings if text)])


class VaryJob(EditJob):
    """Vary the whole human."""

    kind = method = "vary"
    undo, made = "Vary Human", "Varied"


class RedressJob(EditJob):
    """Generate a region again."""

    kind = method = "inpaint"
    undo, made = "Re-dress Region", "Re-dressed"


class TransferJob(EditJob):
    """Transfer a region from another human."""

    kind = method = "transfer"
    undo, made = "Transfer Texture", "Texture transferred to"


class BlendJob(EditJob):
    """Blend with another human."""

    kind = method = "interpolate"
    undo, made = "Blend Humans", "Blended"


@dataclasses.dataclass(frozen=True)
class RegenerateJob(Job):
    """Generate a human that has lost all files again from its seed, in its place."""

    kind = "regenerate"
    method = "generate"
    undo = "Generate Again"

    target: HumanTarget
    made: dict[str, Any]
    """The human's provenance."""
    checkpoint: str = dataclasses.field(default_factory=lambda: chosen_checkpoint("checkpoint"))

    @property
    def label(self) -> str:
        return f"Generate {self.target.name} again, seed {self.made['seed']}"

    def params(self, folder: Path) -> dict[str, Any]:
        asked = {name: self.made[name] for name in ("steps", "sampler", "attributes", "guidance") if name in self.made}
        checkpoint = {"checkpoint": self.checkpoint} if self.checkpoint else {}
        return {"seed": self.made["seed"], **asked, **checkpoint, "size": PREVIEW_PX, "out_dir": str(folder)}

    def replaced(self) -> bpy.types.Collection:
        return self.target.found()

    def finish(self, context: bpy.types.Context, result: HumanAnswer, _folder: Path) -> str:
        """Raises ValueError where another checkpoint has generated another human."""
        person = self.target.found()
        made, before = made_of(read_tensors(result.person).metadata), provenance_of(person)
        for name in ("checkpoint_sha256", "checkpoint"):
            if name in before and made.get(name) != before[name]:
                other = as_shown(before.get("checkpoint"))
                raise ValueError(
                    f"{person.name!r} was made by the checkpoint {other!r}, and this one is "
                    f"{made.get('checkpoint')!r}: choose that one in the preferences, "
                    "otherwise the result would be another human"
                )
        show_in_place(context, person, result)
        look()
        return f"{person.name} generated again from seed {self.made['seed']} in {result.seconds:.1f} s"


def made_from_seed(person: bpy.types.Collection) -> dict[str, Any]:
    """The provenance of a human that its seed reproduces. Raises ValueError for others."""
    made = provenance_of(person)
    if made.get("edits"):
        raise ValueError(
            f"{person.name!r} was edited after they were generated, so no seed reproduces them: restore their files"
        )
    if not isinstance(made.get("seed"), int) or "steps" not in made:
        raise ValueError(f"{person.name!r} was not generated from a seed: restore their files")
    return made
