"""Variations: the job that generates several humans, and the contact sheet that holds them."""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy

from ..backend.requests import sentence
from ..files.regular_files import remove_folder
from ..formats.answers import VariationFiles, VariationsAnswer
from ..scene.human import BODY_FILE, PERSON_FILE
from .queue import Job, chosen_checkpoint
from .windows import icons

NAMES = {"person": PERSON_FILE, "picture": "picture.png"}
"""Files of a human, by their names in the child's result."""


@dataclasses.dataclass
class Variation:
    """A human on the sheet."""

    seed: int
    folder: Path
    """Holds NAMES, and BODY_FILE where the human is on a body of the user's files."""
    chosen: bool = False

    @property
    def person(self) -> Path:
        return self.folder / NAMES["person"]

    @property
    def picture(self) -> Path:
        return self.folder / NAMES["picture"]


class Sheet:
    """The humans to choose from. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.variations: list[Variation] = []
        self.title = ""
        self.of = 0
        """Session uid of the human instead of whom they may be shown; 0 for none."""
        self._folder: Path | None = None

    def fill(self, people: Sequence[VariationFiles], title: str, of: int = 0) -> None:
        """Move the files of the child's `people` here, replacing those before. Raises OSError before any change."""
        folder = Path(tempfile.mkdtemp(prefix="variation_sheet_", dir=bpy.app.tempdir or None))
        made = []
        try:
            for number, person in enumerate(people):
                own = folder / f"{number:02d}"
                own.mkdir()
                for name, file in NAMES.items():
                    shutil.move(getattr(person, name), own / file)
                if (body := person.person.with_name(BODY_FILE)).is_file():
                    shutil.copyfile(body, own / BODY_FILE)
                made.append(Variation(person.seed, own))
        except OSError:
            remove_folder(folder, folder.parent)
            raise
        self.clear()
        self.variations, self.title, self.of, self._folder = made, title, of, folder

    def clear(self) -> None:
        """Remove all variations and their files."""
        if self._folder is not None:
            remove_folder(self._folder, self._folder.parent)
        self.variations, self.title, self.of, self._folder = [], "", 0, None

    def chosen(self) -> list[Variation]:
        """The selected ones. Raises ValueError for none."""
        found = [variation for variation in self.variations if variation.chosen]
        if not found:
            raise ValueError("no variation is selected: click the seeds below the pictures")
        return found


sheet, backs = Sheet(), Sheet()
"""Sheets of Variations and of the last human from a picture; for all windows and scenes."""

PICTURE_PX = 256


@dataclasses.dataclass(frozen=True)
class VariationsJob(Job):
    """Show Variations, and More Like This."""

    kind = method = "variations"

    seeds: tuple[int, ...]
    sampling: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Other fields of `VariationsRequest`: steps, sampler, attributes, guidance."""
    person: str = ""
    """File of the human to vary; empty for new humans."""
    amount: float = 0.5
    title: str = "New humans"
    checkpoint: str = dataclasses.field(default_factory=chosen_checkpoint)

    @property
    def label(self) -> str:
        return f"{len(self.seeds)} Variations"

    def params(self, folder: Path) -> dict[str, Any]:
        params: dict[str, Any] = {"seeds": list(self.seeds), **self.sampling}
        if self.person:
            if not Path(self.person).is_file():
                raise FileNotFoundError("the human to vary was cleared: show variations again")
            params |= {"person": self.person, "amount": self.amount}
        if self.checkpoint:
            params["checkpoint"] = self.checkpoint
        return {**params, "size": PICTURE_PX, "out_dir": str(folder)}

    def finish(self, _context: bpy.types.Context, result: VariationsAnswer, _folder: Path) -> str:
        sheet.fill(result.people, self.title)
        icons.free()  # of the steps
        return " ".join([f"{len(self.seeds)} humans in {result.seconds:.1f} s.", *map(sentence, result.warnings)])
