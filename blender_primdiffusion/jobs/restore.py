"""People whose volumes are lost, made again by the child: from their own file, or else from their seed."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import bpy

from ..scene.edit import edit_destination, restore_destination, restore_volumes
from ..scene.human import MARK
from ..scene.human_npz import read_human
from ..scene.writing import Destination, write_now
from .building import building
from .job import Job, chosen_checkpoint
from .person import show_in_place
from .target import Target

_PICTURE_PX = 16
"""The child's pictures of the person are of no use here."""


@dataclasses.dataclass(frozen=True)
class RestoreJob(Job):
    """Volumes written again from the backend's file of a person: exactly those that were lost."""

    kind = "restore_volumes"
    method = "human_npz"
    undo = "Restore Volumes"

    target: Target
    file: str
    """The backend's."""

    @property
    def label(self) -> str:
        """For people."""
        return f"Restore Volumes of {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method."""
        return {"person": self.file, "out_dir": str(folder), "size": _PICTURE_PX}

    def place(self) -> Destination:
        """Where the lost ones were."""
        return restore_destination(self.target.found())

    def finish(self, _context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Put the volumes back."""
        person, human, file = self.target.found(), Path(result["human"]), Path(self.file)
        written = building.take(human) or write_now(human, restore_destination(person))
        count = restore_volumes(person, written, file)
        _look()
        return f"{count} volumes of {person.name} restored from their file in {result['seconds']:.1f} s"


@dataclasses.dataclass(frozen=True)
class RegenerateJob(Job):
    """Somebody generated once more from their seed, in the place of one who has lost all files."""

    kind = "regenerate"
    method = "generate"
    undo = "Generate Again"

    target: Target
    made: dict[str, Any]
    """The person's provenance."""
    checkpoint: str = dataclasses.field(default_factory=lambda: chosen_checkpoint("checkpoint"))

    @property
    def label(self) -> str:
        """For people."""
        return f"Generate {self.target.name} again, seed {self.made['seed']}"

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method."""
        asked = {name: self.made[name] for name in ("steps", "sampler", "attributes", "guidance") if name in self.made}
        checkpoint = {"checkpoint": self.checkpoint} if self.checkpoint else {}
        return {"seed": self.made["seed"], **asked, **checkpoint, "size": _PICTURE_PX, "out_dir": str(folder)}

    def place(self) -> Destination:
        """Where the lost ones were."""
        return edit_destination(self.target.found())

    def finish(self, context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Show them where the lost ones were. Raises ValueError where another checkpoint has made somebody else."""
        person, human = self.target.found(), Path(result["human"])
        made, before = read_human(human).meta, json.loads(person[MARK])
        for name in ("checkpoint_sha256", "checkpoint"):
            if name in before and made.get(name) != before[name]:
                raise ValueError(
                    f"{person.name!r} was made by the checkpoint {before.get('checkpoint')!r}, and this one is "
                    f"{made.get('checkpoint')!r}: choose that one in the preferences, "
                    "otherwise the result would be another person"
                )
        show_in_place(context, person, result)
        _look()
        return f"{person.name} generated again from seed {self.made['seed']} in {result['seconds']:.1f} s"


def made_from_seed(person: bpy.types.Collection) -> dict[str, Any]:
    """The person's provenance, of one whom their seed makes again. Raises ValueError, telling why, for others."""
    made = json.loads(person[MARK])
    if made.get("edits"):
        raise ValueError(
            f"{person.name!r} was edited after they were generated, so no seed reproduces them: restore their files"
        )
    if not isinstance(made.get("seed"), int) or "steps" not in made:
        raise ValueError(f"{person.name!r} was not generated from a seed: restore their files")
    return made


def _look() -> None:
    from .missing_files import look

    look()
