"""Find missing files of humans and repair the paths to them.

What a human needs is its own file: the volumes beside it are written from it. So a human is found where a file is that
says that it was made alike, and has its betas; all of its volumes then point to that folder.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import bpy
import numpy as np

from ..formats.human_layout import provenance_of as provenance_in
from ..formats.regular_files import exists_in_its_folder, real_path
from .blend_values import as_shown, stored_folder
from .human import (
    BODY_FILE,
    HOME,
    MARK,
    MERGED_VDB,
    PERSON_FILE,
    PRIMITIVE_VDB,
    STATE,
    folder_of,
    humans_folder,
    provenance_of,
    state_folder,
    stored_path,
    volume_path,
)
from .human_file import file_version, payload_in, read_sizes, read_tensors
from .shape import generated_betas
from .volumes import reload_volume

_LONGEST_SEQUENCE = 100_000
"""Frames of a merged volume whose files are looked for."""
_DEEPEST = 6
_MOST_FOLDERS = 20_000
_SAME_BETAS = 1e-4


@dataclasses.dataclass(frozen=True)
class MissingFiles:
    """The missing files of one human. Holds references to Blender's data, so it must not be stored."""

    person: bpy.types.Collection
    volumes: tuple[bpy.types.Volume, ...]
    """Volumes of primitives, where the human's own file is missing."""
    merged: tuple[bpy.types.Volume, ...]
    """Merged volumes without all of their files."""
    file: str
    """Name of the human's own file or that of its body; empty where both exist."""

    @property
    def linked(self) -> str:
        """Path of the .blend that the human is linked from; empty for this one."""
        holder = next((v for v in (*self.volumes, *self.merged, self.person) if v.library is not None), None)
        return as_shown(holder.library.filepath or holder.library.name) if holder is not None else ""

    def summary(self) -> str:
        """For messages, for instance: person.human.safetensors of 'Human'."""
        parts = [self.file] if self.file else []
        parts += ["the merged volume"] if self.merged else []
        return f"{', '.join(parts)} of {self.person.name!r}"


def missing_files() -> list[MissingFiles]:
    """Missing files of all humans in the .blend, linked ones included."""
    lost = []
    for person in bpy.data.collections:
        if MARK not in person:
            continue
        file = _missing_file(state_folder(person))
        merged = [volume for volume in _volumes(person, MERGED_VDB) if not _is_complete(volume, None)]
        if file or merged:
            volumes = _volumes(person, PRIMITIVE_VDB) if file else []
            lost.append(MissingFiles(person, tuple(volumes), tuple(merged), file))
    return lost


def _missing_file(state: Path) -> str:
    """The name of the file that a state's folder lacks; empty where it is whole."""
    if not exists_in_its_folder(state / PERSON_FILE):
        return PERSON_FILE
    if exists_in_its_folder(state / BODY_FILE):
        return ""
    try:
        sizes = read_sizes(file_version(state / PERSON_FILE))
        return "" if sizes.rest_half_extent is None else BODY_FILE
    except (OSError, ValueError):  # damaged, not missing
        return ""


def repair(lost: Sequence[MissingFiles], directory: Path | None = None) -> int:
    """Point humans, and merged volumes, to the folders that have their files; returns how many. Linked ones stay.

    Looks beside the .blend, in the folders of its humans when it was last saved, in the folders of other humans, and
    then in `directory` and below. Raises NotADirectoryError where that is no folder.
    """
    if directory is not None and not os.path.isdir(directory):
        raise NotADirectoryError(f"there is no folder {str(directory)!r:.200}: choose the one that the humans are in")
    repaired = 0
    for one in lost:
        if one.linked:
            continue
        state = next((folder for folder in _search_folders(directory) if _holds(folder, one.person)), None)
        if one.file and state is not None:
            for volume in one.volumes:
                _point(volume, state / volume_path(volume).name)
            one.person[HOME] = str(state)
            repaired += 1
        for volume in one.merged:
            folder = next((folder for folder in _search_folders(directory) if _is_complete(volume, folder)), None)
            if folder is not None:
                _point(volume, folder / volume_path(volume).name)
                repaired += 1
    return repaired


def _point(volume: bpy.types.Volume, path: Path) -> None:
    volume.filepath = stored_path(path)
    if volume.grids.error_message and exists_in_its_folder(path):
        reload_volume(volume)


def _holds(folder: Path, person: bpy.types.Collection) -> bool:
    """Whether a folder is whole and its human was made as this one, and has its betas."""
    if not exists_in_its_folder(folder / PERSON_FILE) or _missing_file(folder):
        return False
    try:
        tensors = read_tensors(folder / PERSON_FILE)
        made, betas = provenance_in(tensors.metadata), payload_in(tensors, PERSON_FILE).betas
        wanted = provenance_of(person)
        return made.items() <= wanted.items() and np.allclose(betas, generated_betas(person), atol=_SAME_BETAS)
    except (OSError, ValueError):
        return False


def _volumes(person: bpy.types.Collection, pattern: re.Pattern[str]) -> list[bpy.types.Volume]:
    """Volumes of a human whose files have such names."""
    paths = {obj.data: volume_path(obj.data) for obj in person.all_objects if obj.type == "VOLUME"}
    return [volume for volume, path in paths.items() if path is not None and pattern.fullmatch(path.name)]


def _is_complete(volume: bpy.types.Volume, folder: Path | None) -> bool:
    """Whether all files of a merged volume are in a folder, or where it shows them."""
    path = volume_path(volume)
    match, folder = MERGED_VDB.fullmatch(path.name), path.parent if folder is None else folder
    if match is None or match[1] is None or not volume.is_sequence:
        return exists_in_its_folder(folder / path.name)
    width, last = len(match[1]) - 1, min(volume.frame_duration, _LONGEST_SEQUENCE)
    names = (path.name.replace(match[1], f"_{number:0{width}d}") for number in range(1, last + 1))
    return all(exists_in_its_folder(folder / name) for name in names)


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
    homes = [home for person in humans if (home := stored_folder(person, HOME)) is not None]
    shown = sorted({path.parent for volume in bpy.data.volumes if (path := volume_path(volume)) is not None})
    yield from (*homes, *shown)
    yield from (humans_folder() / folder.parent.name / folder.name for folder in (*homes, *shown))
    around = (folder.parent if STATE.fullmatch(folder.name) else folder for folder in (*homes, *shown))
    roots = [humans_folder(), *(human.parent for human in around)]
    blend = Path(bpy.data.filepath)
    if blend.name:
        roots += _folders_in(real_path(blend).parent, "_humans")  # of a .blend that had another name
    for human in itertools.chain(map(folder_of, humans), *map(_folders_in, dict.fromkeys(roots))):
        yield human
        yield from reversed(_folders_in(human))


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
