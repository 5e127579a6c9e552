"""Find missing files of humans and repair the paths to them.

Names of volumes and bodies contain a hash, so a file of the right name is the right file wherever it is. The backend's
file of a human that was never edited has a plain name: it is identified by the volumes beside it, or by its betas.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import bpy
import numpy as np

from ..formats.regular_files import exists_in_its_folder, real_path
from .blend_values import as_shown, stored_folder
from .body_file import stored_body_name
from .human import (
    HOME,
    MARK,
    MERGED_VDB,
    PERSON_FILE,
    PRIMITIVE_VDB,
    copy_file,
    folder_of,
    folders_of,
    home_of,
    humans_folder,
    person_file_name,
    stored_path,
    unwritten_in,
    volume_path,
)
from .human_file import read_tensors
from .shape import generated_betas

_LONGEST_SEQUENCE = 100_000
"""Frames of a merged volume whose files are looked for."""
_DEEPEST = 6
_MOST_FOLDERS = 20_000
_SAME_BETAS = 1e-4


class Listing:
    """File names by folder. Each folder is read once: a thousand single checks take a second on a network drive."""

    def __init__(self) -> None:
        self._names: dict[Path, frozenset[str]] = {}

    def names(self, folder: Path) -> frozenset[str]:
        """Names of the files in a folder; none where it does not exist or cannot be read."""
        if folder not in self._names:
            try:
                with os.scandir(folder) as entries:  # a pipe named like a volume would hang Blender
                    self._names[folder] = frozenset(entry.name for entry in entries if _is_file(entry))
            except OSError:
                self._names[folder] = frozenset()
        return self._names[folder]

    def __contains__(self, path: Path) -> bool:
        return path.name in self.names(path.parent)

    def found(self, wanted: Iterable[str], folders: Iterable[Path]) -> dict[str, Path]:
        """Paths of the wanted names, each in the first of the folders that has it."""
        left, paths = set(wanted), {}
        for folder in folders:
            if not left:
                break
            for name in left & self.names(folder):
                paths[name] = folder / name
            left -= paths.keys()
        return paths


@dataclasses.dataclass(frozen=True)
class MissingFiles:
    """The missing files of one human. Holds references to Blender's data, so it must not be stored."""

    person: bpy.types.Collection
    volumes: tuple[bpy.types.Volume, ...]
    """Volumes of primitives without their file, if that is not yet to be written."""
    merged: tuple[bpy.types.Volume, ...]
    """Merged volumes without all of their files."""
    person_file: str
    """Name of the backend's file; empty when it exists."""
    body_file: str
    """Name of the body's file; empty when it exists."""

    @property
    def linked(self) -> str:
        """Path of the .blend that the human is linked from; empty for this one."""
        holder = next((v for v in (*self.volumes, *self.merged, self.person) if v.library is not None), None)
        return as_shown(holder.library.filepath or holder.library.name) if holder is not None else ""

    def summary(self) -> str:
        """For messages, for instance: 12 volumes of 'Human'."""
        parts = []
        if self.volumes:
            parts.append(f"{len(self.volumes)} {'volume' if len(self.volumes) == 1 else 'volumes'}")
        parts += [name for name in (self.person_file, self.body_file) if name]
        parts += ["the merged volume"] if self.merged else []
        return f"{', '.join(parts)} of {self.person.name!r}"


def missing_files() -> list[MissingFiles]:
    """Missing files of all humans in the .blend, linked ones included. Reads each folder once."""
    listing, lost = Listing(), []
    for person in bpy.data.collections:
        if MARK not in person:
            continue
        single, several = _without_files(person, listing)
        near = folders_of(person)
        name, body = person_file_name(person), stored_body_name(person) or ""
        has_person = any(folder / name in listing for folder in near)
        has_body = not body or any(path / body in listing for folder in near for path in (folder.parent, folder))
        if single or several or not (has_person and has_body):
            wanted = "" if has_person else name
            lost.append(MissingFiles(person, tuple(single), tuple(several), wanted, "" if has_body else body))
    return lost


def find_files(lost: Sequence[MissingFiles], directory: Path | None = None) -> dict[str, Path]:
    """Paths, by name, of files of volumes, bodies and edited humans.

    Looks beside the .blend, in the folders of its humans when it was last saved, in the folders of other humans, and
    then in `directory` and below. Raises NotADirectoryError where that is no folder.
    """
    if directory is not None and not os.path.isdir(directory):
        raise NotADirectoryError(f"there is no folder {str(directory)!r:.200}: choose the one that the volumes are in")
    wanted = {
        *(_name(volume) for one in lost for volume in one.volumes),
        *(name for one in lost for volume in one.merged for name in _sequence_names(volume)),
        *(one.body_file for one in lost),
        *(one.person_file for one in lost if one.person_file != PERSON_FILE),
    } - {""}
    return Listing().found(wanted, _search_folders(directory))


def find_person(lost: MissingFiles, directory: Path | None = None) -> Path | None:
    """Where the backend's file of a human is now; None where it is not found. Does not raise."""
    if not lost.person_file:
        near = [folder / person_file_name(lost.person) for folder in folders_of(lost.person)]
        return next((path for path in near if exists_in_its_folder(path)), None)
    listing = Listing()
    own = {_name(obj.data) for obj in lost.person.all_objects if obj.type == "VOLUME"}
    for folder in _search_folders(directory):
        if lost.person_file not in listing.names(folder):
            continue
        path = folder / lost.person_file
        if lost.person_file != PERSON_FILE or own & listing.names(folder) or _has_betas(path, lost.person):
            return path
    return None


def repair(lost: Sequence[MissingFiles], found: dict[str, Path]) -> int:
    """Point volumes to the files that were found; returns how many. Linked volumes stay as they are."""
    repaired = 0
    for one in lost:
        for volume in one.volumes:
            path = found.get(_name(volume))
            if path is not None and volume.library is None:
                volume.filepath = stored_path(path)
                repaired += 1
        for volume in one.merged:
            path = found.get(_name(volume))
            complete = path is not None and {*_sequence_names(volume)} <= Listing().names(path.parent)
            if complete and volume.library is None:
                volume.filepath = stored_path(path)
                repaired += 1
    return repaired


def copy_back(lost: Sequence[MissingFiles], found: dict[str, Path], directory: Path | None = None) -> int:
    """Copy the backend's and the body's files that were found to the human's folder; returns how many.

    Call `repair` first. Raises OSError, and ValueError where that folder lies behind a link or what was found is one.
    """
    copied = 0
    for one in lost:
        if one.linked or not os.path.isdir(folders_of(one.person)[0]):
            continue
        home = home_of(one.person)
        if one.person_file and not os.path.lexists(home / one.person_file):
            source = find_person(one, directory)
            copied += source is not None and copy_file(source, home / one.person_file, home.parent)
        paths = [home.parent / one.body_file, home / one.body_file]
        if one.body_file in found and not any(exists_in_its_folder(path) for path in paths):
            copied += copy_file(found[one.body_file], paths[0], home.parent)
    return copied


def _without_files(
    person: bpy.types.Collection, listing: Listing
) -> tuple[list[bpy.types.Volume], list[bpy.types.Volume]]:
    single, several = [], []
    later = {folder for folder in folders_of(person)[:1] if unwritten_in(folder)}
    for volume in {obj.data: None for obj in person.all_objects if obj.type == "VOLUME"}:
        path = volume_path(volume)
        if path is None:
            continue
        if PRIMITIVE_VDB.fullmatch(path.name) and path not in listing:
            single += [] if path.parent in later else [volume]
        elif MERGED_VDB.fullmatch(path.name) and not {*_sequence_names(volume)} <= listing.names(path.parent):
            several.append(volume)
    return single, several


def _is_file(entry: os.DirEntry[str]) -> bool:
    return exists_in_its_folder(Path(entry.path)) if entry.is_symlink() else os.path.isfile(entry)


def _name(volume: bpy.types.Volume) -> str:
    """The name of a volume's file; empty where it has none."""
    path = volume_path(volume)
    return path.name if path is not None else ""


def _sequence_names(volume: bpy.types.Volume) -> list[str]:
    """Names of all files of a merged volume, missing or not."""
    name = _name(volume)
    match = MERGED_VDB.fullmatch(name)
    if match is None or match[1] is None or not volume.is_sequence:
        return [name]
    width = len(match[1]) - 1
    last = min(volume.frame_duration, _LONGEST_SEQUENCE)
    return [name.replace(match[1], f"_{number:0{width}d}") for number in range(1, last + 1)]


def _search_folders(directory: Path | None) -> Iterator[Path]:
    """Folders in which files of humans may be, the likeliest first."""
    seen: set[Path] = set()
    for folder in _likely_folders():
        if folder not in seen:
            seen.add(folder)
            yield folder
    if directory is not None:
        yield from _folders_below(directory)


def _likely_folders() -> Iterator[Path]:
    humans = [person for person in bpy.data.collections if MARK in person]
    yield from (folder_of(person) for person in humans)
    homes = [home for person in humans if (home := stored_folder(person, HOME)) is not None]
    yield from homes
    shown = {path.parent for volume in bpy.data.volumes if (path := volume_path(volume)) is not None}
    yield from sorted(shown)
    roots = [humans_folder(), *(folder.parent for folder in (*homes, *sorted(shown)))]
    blend = Path(bpy.data.filepath)
    if blend.name:
        roots += _folders_in(real_path(blend).parent, "_humans")  # of a .blend that had another name
    for root in dict.fromkeys(roots):
        yield root
        yield from _folders_in(root)


def _folders_in(folder: Path, ending: str = "") -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return sorted(
                folder / entry.name for entry in entries if os.path.isdir(entry) and entry.name.endswith(ending)
            )
    except OSError:
        return []


def _folders_below(directory: Path) -> Iterator[Path]:
    """A folder and those below it, up to a limit: the user may have chosen a whole disk."""
    for folder, inside, _ in itertools.islice(os.walk(directory), _MOST_FOLDERS):
        yield Path(folder)
        if len(Path(folder).parts) - len(directory.parts) >= _DEEPEST:
            inside.clear()


def _has_betas(path: Path, person: bpy.types.Collection) -> bool:
    """Whether a file holds the betas that the human was generated with."""
    try:
        dtype, _, raw = read_tensors(path).arrays["betas"]
        betas = np.frombuffer(raw, "<f4") if dtype == "F32" else np.empty(0)
        wanted = generated_betas(person)
    except (OSError, ValueError, KeyError):
        return False
    return betas.shape == wanted.shape and np.allclose(betas, wanted, atol=_SAME_BETAS)
