"""What is in folders, each read once: asking for a thousand files one by one takes a second on a network drive."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path


class Listing:
    """Names of files by folder, as they were when the folder was first asked for."""

    def __init__(self) -> None:
        self._names: dict[Path, frozenset[str]] = {}

    def names(self, folder: Path) -> frozenset[str]:
        """Everything in a folder; nothing for one that is not there or may not be read."""
        if folder not in self._names:
            try:
                self._names[folder] = frozenset(os.listdir(folder))
            except OSError:
                self._names[folder] = frozenset()
        return self._names[folder]

    def __contains__(self, path: Path) -> bool:
        return path.name in self.names(path.parent)

    def found(self, wanted: Iterable[str], folders: Iterable[Path]) -> dict[str, Path]:
        """Where the wanted names are; of several folders, the first that has it. Stops when all are found."""
        left, places = set(wanted), {}
        for folder in folders:
            if not left:
                break
            for name in left & self.names(folder):
                places[name] = folder / name
            left -= places.keys()
        return places
