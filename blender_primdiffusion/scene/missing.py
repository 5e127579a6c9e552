"""Files of people that are not where the .blend says: which, where they are instead, and paths put right.

Names of volumes and bodies tell their content, so a file of the right name is the right file wherever it lies. The
backend's file of a person who was never edited has a plain name: it is known by the volumes beside it, or its betas.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import bpy
import numpy as np

from .files import (
    HOME,
    MERGED_VDB,
    PERSON_FILE,
    PRIMITIVE_VDB,
    folder_of,
    folders_of,
    humans_folder,
    person_file_name,
    put_copy,
    stored_path,
    volume_path,
)
from .human import MARK
from .human_file import read_tensors
from .shape import BODY_FILE, generated_betas

_DEEPEST = 6
_MOST_FOLDERS = 20_000
_SAME_BETAS = 1e-4


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


@dataclasses.dataclass(frozen=True)
class Lost:
    """What one person misses. Holds Blender's objects: for use at once."""

    person: bpy.types.Collection
    volumes: tuple[bpy.types.Volume, ...]
    """Of the primitives, without their files."""
    merged: tuple[bpy.types.Volume, ...]
    """Merged ones without all of their files."""
    person_file: str
    """The backend's file; empty when it is there."""
    body_file: str
    """The body's; empty when it is there."""

    @property
    def linked(self) -> str:
        """The .blend that the person lives in; empty for this one."""
        holder = next((v for v in (*self.volumes, *self.merged, self.person) if v.library is not None), None)
        return holder.library.filepath if holder is not None else ""

    def told(self) -> str:
        """Like: 12 volumes of 'Human'."""
        parts = []
        if self.volumes:
            parts.append(f"{len(self.volumes)} {'volume' if len(self.volumes) == 1 else 'volumes'}")
        parts += [name for name in (self.person_file, self.body_file) if name]
        parts += ["the merged volume"] if self.merged else []
        return f"{', '.join(parts)} of {self.person.name!r}"


def missing_files() -> list[Lost]:
    """Of everybody in the .blend, those linked included; empty when everybody is whole. Reads each folder once."""
    listing, lost = Listing(), []
    for person in bpy.data.collections:
        if MARK not in person:
            continue
        single, several = _without_files(person, listing)
        near = folders_of(person)
        name, body = person_file_name(person), str(person.get(BODY_FILE, ""))
        has_person = any(folder / name in listing for folder in near)
        has_body = not body or any(place / body in listing for folder in near for place in (folder.parent, folder))
        if single or several or not (has_person and has_body):
            wanted = "" if has_person else name
            lost.append(Lost(person, tuple(single), tuple(several), wanted, "" if has_body else body))
    return lost


def find_files(lost: Sequence[Lost], directory: Path | None = None) -> dict[str, Path]:
    """Where the files of volumes and bodies, and of edited people, are: by their names.

    Looks beside the .blend, where people were when it was last saved, in the folders of other people, and then in
    `directory` and its folders. Raises NotADirectoryError where that is none.
    """
    if directory is not None and not directory.is_dir():
        raise NotADirectoryError(f"there is no folder {str(directory)!r}: choose the one that the volumes are in")
    wanted = {
        *(path.name for one in lost for volume in one.volumes for path in (volume_path(volume),)),
        *(name for one in lost for volume in one.merged for name in _sequence_names(volume)),
        *(one.body_file for one in lost),
        *(one.person_file for one in lost if one.person_file != PERSON_FILE),
    } - {""}
    return Listing().found(wanted, _places(directory))


def find_person(lost: Lost, directory: Path | None = None) -> Path | None:
    """The backend's file of a person, where it is now; None where it is not found. Raises nothing."""
    if not lost.person_file:
        near = [folder / person_file_name(lost.person) for folder in folders_of(lost.person)]
        return next((path for path in near if path.is_file()), None)
    listing = Listing()
    own = {volume_path(thing.data).name for thing in lost.person.all_objects if thing.type == "VOLUME"}
    for folder in _places(directory):
        if lost.person_file not in listing.names(folder):
            continue
        path = folder / lost.person_file
        if lost.person_file != PERSON_FILE or own & listing.names(folder) or _has_betas(path, lost.person):
            return path
    return None


def repair(lost: Sequence[Lost], found: dict[str, Path]) -> int:
    """Point volumes to the files that were found; how many now show again. Linked ones stay as they are."""
    repaired = 0
    for one in lost:
        for volume in one.volumes:
            path = found.get(volume_path(volume).name)
            if path is not None and volume.library is None:
                volume.filepath = stored_path(path)
                repaired += 1
        for volume in one.merged:
            path = found.get(volume_path(volume).name)
            whole = path is not None and all((path.parent / name).is_file() for name in _sequence_names(volume))
            if whole and volume.library is None:
                volume.filepath = stored_path(path)
                repaired += 1
    return repaired


def bring_back(lost: Sequence[Lost], found: dict[str, Path], directory: Path | None = None) -> int:
    """Copy the backend's and the body's files that were found to where the person's volumes are now; how many.

    For after `repair`. Raises OSError where they cannot be written.
    """
    brought = 0
    for one in lost:
        home = folders_of(one.person)[0]
        if one.linked or not home.is_dir():
            continue
        if one.person_file and not (home / one.person_file).is_file():
            source = find_person(one, directory)
            brought += source is not None and put_copy(source, home / one.person_file)
        places = [home.parent / one.body_file, home / one.body_file]
        if one.body_file in found and not any(place.is_file() for place in places):
            brought += put_copy(found[one.body_file], places[0])
    return brought


def _without_files(
    person: bpy.types.Collection, listing: Listing
) -> tuple[list[bpy.types.Volume], list[bpy.types.Volume]]:
    single, several = [], []
    for volume in {thing.data: None for thing in person.all_objects if thing.type == "VOLUME"}:
        path = volume_path(volume)
        if PRIMITIVE_VDB.fullmatch(path.name) and path not in listing:
            single.append(volume)
        elif MERGED_VDB.fullmatch(path.name) and not {*_sequence_names(volume)} <= listing.names(path.parent):
            several.append(volume)
    return single, several


def _sequence_names(volume: bpy.types.Volume) -> list[str]:
    """Names of all files of a merged volume, there or not."""
    name = volume_path(volume).name
    match = MERGED_VDB.fullmatch(name)
    if match is None or match[1] is None or not volume.is_sequence:
        return [name]
    width = len(match[1]) - 1
    return [name.replace(match[1], f"_{number:0{width}d}") for number in range(1, volume.frame_duration + 1)]


def _places(directory: Path | None) -> Iterator[Path]:
    """Folders in which people's files may be, the likeliest first."""
    seen: set[Path] = set()
    for folder in _likely():
        if folder not in seen:
            seen.add(folder)
            yield folder
    if directory is not None:
        yield from _below(directory)


def _likely() -> Iterator[Path]:
    of_people = [person for person in bpy.data.collections if MARK in person]
    yield from (folder_of(person) for person in of_people)
    homes = [Path(str(person[HOME])) for person in of_people if person.get(HOME)]
    yield from homes
    shown = {volume_path(volume).parent for volume in bpy.data.volumes if volume.filepath}
    yield from sorted(shown)
    roots = [humans_folder(), *(folder.parent for folder in (*homes, *sorted(shown)))]
    blend = Path(bpy.data.filepath)
    if blend.name:
        roots += _folders_in(blend.resolve().parent, "_humans")  # of a .blend that had another name
    for root in dict.fromkeys(roots):
        yield root
        yield from _folders_in(root)


def _folders_in(folder: Path, ending: str = "") -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return sorted(folder / entry.name for entry in entries if entry.is_dir() and entry.name.endswith(ending))
    except OSError:
        return []


def _below(directory: Path) -> Iterator[Path]:
    """A folder and those in it, not for ever: somebody may have chosen a whole disk."""
    for folder, inside, _ in itertools.islice(os.walk(directory), _MOST_FOLDERS):
        yield Path(folder)
        if len(Path(folder).parts) - len(directory.parts) >= _DEEPEST:
            inside.clear()


def _has_betas(path: Path, person: bpy.types.Collection) -> bool:
    """The file holds the body that the person was generated with."""
    try:
        dtype, _, raw = read_tensors(path).arrays["betas"]
        betas = np.frombuffer(raw, "<f4") if dtype == "F32" else np.empty(0)
        wanted = generated_betas(person)
    except (OSError, ValueError, KeyError):
        return False
    return betas.shape == wanted.shape and np.allclose(betas, wanted, atol=_SAME_BETAS)
