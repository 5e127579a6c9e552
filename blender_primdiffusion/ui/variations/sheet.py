"""The contact sheet: people who are made and kept in files, but not in the scene.

Lives beside Blender's data: undo and redo leave it as it is. Its files lie in the temporary folder, and go when it is
cleared, another file is loaded or the extension ends.
"""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy

NAMES = {"human": "human.npz", "person": "person.human.safetensors", "picture": "picture.png"}
"""Files of a person, by the names that the child's answer has for them."""


@dataclasses.dataclass
class Variation:
    """Somebody to choose."""

    seed: int
    folder: Path
    """Holds NAMES."""
    chosen: bool = False

    @property
    def human(self) -> Path:
        """For building them."""
        return self.folder / NAMES["human"]

    @property
    def person(self) -> Path:
        """The backend's own file."""
        return self.folder / NAMES["person"]

    @property
    def picture(self) -> Path:
        """A PNG."""
        return self.folder / NAMES["picture"]


class Sheet:
    """The people to choose from; all methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.variations: list[Variation] = []
        self.title = ""
        """What they are."""
        self.around = False
        """They are variants of one person."""
        self._folder: Path | None = None

    def fill(self, people: Sequence[Mapping[str, Any]], title: str, *, around: bool = False) -> None:
        """Take over the files of the child's `people`; those there were go. Raises OSError, and then these stay."""
        folder = Path(tempfile.mkdtemp(prefix="variation_sheet_", dir=bpy.app.tempdir or None))
        made = []
        try:
            for number, person in enumerate(people):
                own = folder / f"{number:02d}"
                own.mkdir()
                for name, file in NAMES.items():
                    shutil.move(person[name], own / file)
                made.append(Variation(int(person["seed"]), own))
        except OSError:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        self.clear()
        self.variations, self.title, self.around, self._folder = made, title, around, folder

    def clear(self) -> None:
        """Nobody is left, and none of their files."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
        self.variations, self.title, self.around, self._folder = [], "", False, None

    def at(self, index: int) -> Variation:
        """Raises ValueError, saying how many there are."""
        if not 0 <= index < len(self.variations):
            there = f"there are {len(self.variations)}, counted from 0" if self.variations else "show variations first"
            raise ValueError(f"there is no variation {index}: {there}")
        return self.variations[index]

    def chosen(self) -> list[Variation]:
        """Those that are selected. Raises ValueError for none."""
        found = [variation for variation in self.variations if variation.chosen]
        if not found:
            raise ValueError("no variation is selected: click the seeds of those you want")
        return found


sheet = Sheet()
"""Blender has one user: one sheet, the same in all windows and scenes."""
