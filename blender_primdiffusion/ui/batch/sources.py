"""What there is to draw: a .blend, a person's file, a folder of people."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from ...scene.files import PERSON_FILE

PERSON_ENDINGS = (".human.safetensors", ".human")


@dataclasses.dataclass(frozen=True)
class Source:
    """One of them."""

    name: str
    """Of the pictures."""
    path: Path

    @property
    def is_blend(self) -> bool:
        """Whether it is a .blend; else a person's file."""
        return self.path.suffix == ".blend"

    @property
    def has_npz(self) -> bool:
        """Whether the person's folder may hold what Blender needs of it."""
        return self.path.name == PERSON_FILE


def sources(path: Path) -> list[Source]:
    """Everybody whom `path` names, sorted by name. Raises ValueError where it names nobody."""
    path = path.resolve()
    if path.is_dir():
        found = sorted(_in_folder(path), key=lambda source: source.name)
        if not found:
            raise ValueError(f"{path} holds no people: name a folder that `generate` wrote, or of .human files")
        return found
    if path.suffix == ".blend":
        return [Source(path.stem, path)]
    if path.name.endswith(PERSON_ENDINGS):
        return [Source(path.parent.name if path.name == PERSON_FILE else _stem(path), path)]
    raise ValueError(f"{path} is neither a .blend nor a person (.human, .human.safetensors): name one of these")


def _in_folder(folder: Path) -> Iterator[Source]:
    if (folder / PERSON_FILE).is_file():
        yield Source(folder.name, folder / PERSON_FILE)
        return
    for path in folder.iterdir():
        if path.name.startswith("."):
            continue
        if (path / PERSON_FILE).is_file():
            yield Source(path.name, path / PERSON_FILE)
        elif path.is_file() and path.name.endswith(PERSON_ENDINGS):
            yield Source(_stem(path), path)


def _stem(path: Path) -> str:
    ending = next(ending for ending in PERSON_ENDINGS if path.name.endswith(ending))
    return path.name.removesuffix(ending)
