"""Keep the files of a .blend's humans in its own folder, and find those that are no longer used.

Whatever is saved has all files of its humans in `humans_folder` of its own name: those from a temporary folder, from
the .blend that it was saved from under another name, and of appended humans. So no .blend depends on another one's
folder, except those that link humans from it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..formats.regular_files import exists_in_its_folder, real_path
from ..formats.removing import OutsideFolderError, check_inside, remove_file
from ..formats.whole_files import remove_empty
from .blend_values import as_shown, stored_folder, stored_name, stored_text
from .body_file import BODY_FILE, BODY_NPZ, body_file, body_files, stored_body_name
from .human import (
    HOME,
    MARK,
    MERGED_VDB,
    PERSON,
    PERSON_FILES,
    PRIMITIVE_VDB,
    UNWRITTEN_NPZ,
    VolumeWriteError,
    available_name,
    copy_file,
    folders_of,
    humans_folder,
    is_own,
    person_file_name,
    sequence_files,
    stored_path,
    unwritten_in,
    volume_path,
)
from .vdb import readable_format
from .volumes import format_of, reload_volume

_OURS = (PRIMITIVE_VDB, PERSON_FILES, BODY_NPZ, MERGED_VDB, UNWRITTEN_NPZ)


@dataclasses.dataclass(frozen=True)
class Collected:
    """What was copied."""

    volumes: int
    """Volumes that show another file now."""
    files: int
    """Files that did not exist before."""
    size: int
    """Bytes of these files."""


@dataclasses.dataclass
class _Changes:
    """What collecting has changed, to be taken back where the file that is written is not the open one."""

    paths: dict[bpy.types.Volume, str] = dataclasses.field(default_factory=dict)
    """Paths of volumes before."""
    names: dict[bpy.types.Collection, str | None] = dataclasses.field(default_factory=dict)
    """Names of the humans' own files before; None where none was stored."""
    made: list[Path] = dataclasses.field(default_factory=list)
    """Files that did not exist before."""
    target: Path | None = None
    """The folder of humans in which they are."""

    def remove_made(self) -> None:
        for path in self.made:
            with contextlib.suppress(OSError):
                remove_file(path, path.parent)
        if self.target is not None:
            remove_empty([*{path.parent for path in self.made} - {self.target}, self.target])
        self.made.clear()

    def take_back(self) -> None:
        for volume, path in self.paths.items():
            volume.filepath = path
        for person, name in self.names.items():
            if name is None:
                del person[PERSON]
            else:
                person[PERSON] = name
        self.forget()

    def forget(self) -> None:
        self.paths.clear()
        self.names.clear()
        self.made.clear()


_saving = _Changes()
"""Of the file that is being saved."""


def collect_own_files(blend_path: str) -> Collected:
    """Copy files of humans from elsewhere to the folder of `blend_path`, and point to the copies.

    Elsewhere are temporary folders, also those of an earlier Blender that has crashed, and the folders of other .blend
    files. Missing files are left out, and those that the .blend does not use stay, for undo. In a .blend never saved,
    paths become absolute: Blender makes them relative when it first writes it. Raises VolumeWriteError when the folder
    beside the .blend cannot be written.
    """
    return _collect(blend_path, _elsewhere(humans_folder(blend_path)), _saving)


def collect_unwritten() -> Collected:
    """Copy files of humans elsewhere, whose volumes are still to be written or written again, to the temporary folder
    of this Blender, and point to the copies: they are written there. Linked humans are among them, in this session.

    Only paths of volumes change, and names of the backend's files. Raises VolumeWriteError.
    """
    waiting = _waiting(bpy.data.filepath)
    return _collect("", waiting, _Changes()) if waiting else Collected(0, 0, 0)


def collect_files() -> Collected:
    """Copy all files of this .blend's humans beside it, and point to the copies; files of linked humans stay.

    Raises ValueError for a .blend that was never saved, FileNotFoundError where files are missing, and VolumeWriteError
    where they cannot be written; then nothing has changed.
    """
    if not bpy.data.filepath:
        raise ValueError("this file was never saved: save it first, which collects the files of its humans too")
    away = _elsewhere(humans_folder())
    present = _present(away)
    gone = [path for volume, path in away.items() if volume not in present]
    if gone:
        raise FileNotFoundError(
            f"{len(gone)} volumes have lost their files, {str(gone[0])!r} among them: press Find Missing Volumes in "
            "the panel Human first"
        )
    return _collect(bpy.data.filepath, away, _Changes())


def store_folders() -> None:
    """Store with each human where its files are, in case the .blend is moved without them."""
    for person in bpy.data.collections:
        if MARK in person and person.library is None:
            home = folders_of(person)[0]
            if os.path.isdir(home) and stored_folder(person, HOME) != home:
                person[HOME] = str(home)


@persistent
def collect_before_saving(blend_path: str, *_: object) -> None:
    """Handler of save_pre. After a failure, which is printed, the .blend is saved pointing to where the files were."""
    _saving.forget()
    if not os.path.isdir(os.path.dirname(blend_path)):  # the start-up file has no path; others cannot be written
        return
    for fault in ignored_values():
        print(f"PrimDiffusion: {fault}")
    try:
        collect_own_files(blend_path)
    except OSError as error:
        print(f"PrimDiffusion: humans of this file depend on files elsewhere: {error}")
    store_folders()


def finish_saving(blend_path: str) -> None:
    """After saving: where a copy was written (Save Copy), the open .blend points to its own files again."""
    if real_path(bpy.data.filepath or ".") != real_path(blend_path or "."):
        _saving.take_back()
    _saving.forget()


def give_up_saving() -> None:
    """After a .blend could not be written: everything is as it was before."""
    _saving.remove_made()
    _saving.take_back()


def ignored_values() -> list[str]:
    """Names and paths of files that this .blend stores with its humans and that no file of a human can have, each in a
    sentence. They count as missing."""
    found = []
    for person in bpy.data.collections:
        if MARK not in person or person.library is not None:
            continue
        valid = {
            PERSON: stored_name(person, PERSON, PERSON_FILES) is not None,
            BODY_FILE: stored_body_name(person) is not None,
            HOME: stored_folder(person, HOME) is not None,
        }
        found += [
            f"the custom property {name!r} of {as_shown(person.name)!r} is ignored: it does not name what it should"
            for name, is_valid in valid.items()
            if name in person and not is_valid
        ]
        volumes = {obj.data for obj in person.all_objects if obj.type == "VOLUME" and obj.data.filepath}
        if strange := sorted(volume.name for volume in volumes if volume_path(volume) is None):
            found.append(
                f"the volume {as_shown(strange[0])!r} of {as_shown(person.name)!r}, one of {len(strange)}, is ignored: "
                "its path is not one of a human's volume"
            )
    return found


def unused(folder: Path) -> list[Path]:
    """Files in `folder`, of earlier states of humans, that nothing in the current .blend points to.

    Undo may still need them, and so may other .blend files that share the folder.
    """
    if not folder.is_dir():
        return []
    used = {real_path(path) for volume in bpy.data.volumes for path in sequence_files(volume)}
    in_use = _person_files() | body_files()
    later = {path.parent for path in used if not path.is_file()}
    found = []
    for path in sorted(folder.rglob("*")):
        named_so = any(pattern.fullmatch(path.name) for pattern in _OURS)
        needed = UNWRITTEN_NPZ.fullmatch(path.name) and real_path(path.parent) in later
        if named_so and path.name not in in_use and real_path(path) not in used and not needed:
            found.append(path)
    return found


def _person_files() -> set[str]:
    """Names of the backend's files that humans of this .blend use, linked ones included."""
    return {person_file_name(collection) for collection in bpy.data.collections if MARK in collection}


def _local() -> dict[bpy.types.Volume, Path]:
    """Volumes of humans in this .blend that are not linked, and their paths."""
    shown = {
        obj.data: None
        for person in bpy.data.collections
        if MARK in person
        for obj in person.all_objects
        if obj.type == "VOLUME" and obj.data.library is None
    }
    paths = {volume: volume_path(volume) for volume in shown}
    return {volume: path for volume, path in paths.items() if path is not None}


def _waiting(blend_path: str) -> dict[bpy.types.Volume, Path]:
    """Volumes of humans, linked ones included, that are to be written in a folder that is not the own one of
    `blend_path`, from a file there or since a newer Blender wrote them; and their paths."""
    found: dict[bpy.types.Volume, Path] = {}
    for person in bpy.data.collections:
        if MARK not in person or is_own(folder := folders_of(person)[0], blend_path):
            continue
        volumes = {obj.data for obj in person.all_objects if obj.type == "VOLUME"}
        paths = {volume: path for volume in volumes if (path := volume_path(volume)) is not None}
        beside = {volume: path for volume, path in paths.items() if path.parent == folder}
        missing = not all(map(exists_in_its_folder, beside.values()))
        if (missing and unwritten_in(folder)) or _is_newer(next(iter(beside.values()), None)):
            found |= beside
    return found


def _is_newer(path: Path | None) -> bool:
    """Whether only a newer Blender can read this volume; those of a human are alike."""
    return path is not None and (format_of(path) or 0) > readable_format()


def _elsewhere(target: Path) -> dict[bpy.types.Volume, Path]:
    """Volumes of humans in this .blend that are not linked and whose files are not in `target`, and their paths."""
    paths = _local()
    outside = {folder: not _inside(folder / "file", target) for folder in {path.parent for path in paths.values()}}
    return {volume: path for volume, path in paths.items() if outside[path.parent]}


def _collect(blend_path: str, away: Mapping[bpy.types.Volume, Path], changes: _Changes) -> Collected:
    """Copy the files of the volumes `away` and of their humans; what changes is added to `changes`."""
    target = humans_folder(blend_path)
    sources = _present(away)
    files = _files_by_folder(sources)
    homes = {folder: _home(folder, paths, target) for folder, paths in files.items()}
    moved = {volume: homes[path.parent] / path.name for volume, path in sources.items()}
    copies = {path: homes[folder] / path.name for folder, paths in files.items() for path in paths}
    names = {}
    for person in bpy.data.collections:
        if MARK in person:
            copies |= _of_person(person, moved, target, names)
    made, changes.target = changes.made, target
    try:
        for source, destination in copies.items():
            if not _there(source, destination) and copy_file(source, destination, target, may_link=True):
                made.append(destination)
    except (OSError, OutsideFolderError) as error:
        changes.remove_made()
        raise VolumeWriteError(
            f"the files of humans could not be copied to {str(target)!r} ({error}); save the .blend in a folder with "
            "write permission and free space"
        ) from error
    for volume, path in moved.items():
        changes.paths[volume] = volume.filepath
        volume.filepath = stored_path(path) if blend_path else str(path)
        if volume.grids.error_message:  # its file was missing, and was written since
            reload_volume(volume)
    for person, name in names.items():
        changes.names[person] = stored_text(person, PERSON)
        person[PERSON] = name
    return Collected(len(moved), len(made), sum(path.stat().st_size for path in made))


def _of_person(
    person: bpy.types.Collection,
    moved: dict[bpy.types.Volume, Path],
    target: Path,
    names: dict[bpy.types.Collection, str],
) -> dict[Path, Path]:
    """Copies of the backend's and the body's file to where the human's volumes go, or to `human.folder_of` it without
    any; new names are added to `names`."""
    near = folders_of(person)
    volume = next((obj.data for obj in person.all_objects if obj.type == "VOLUME"), None)
    stays = person.library is not None if volume is None else volume not in moved
    if stays:
        return {}
    home, copies = target / bpy.path.clean_name(person.name) if volume is None else moved[volume].parent, {}
    name = person_file_name(person)
    file = next((path for path in (folder / name for folder in near) if exists_in_its_folder(path)), None)
    if file is not None and file.parent != home:
        name = available_name(file, home, file.name)
        copies[file] = home / name
        if name != person_file_name(person):
            names[person] = name
    body = body_file(person)
    if body is not None and exists_in_its_folder(body):
        copies[body] = target / body.name
    return copies


def _files_by_folder(sources: Mapping[bpy.types.Volume, Path]) -> dict[Path, list[Path]]:
    """The files of volumes, and those that volumes are written from, by their folder."""
    found: dict[Path, dict[Path, None]] = {path.parent: {} for path in sources.values()}
    for volume, path in sources.items():
        found[path.parent] |= {file: None for file in sequence_files(volume) if exists_in_its_folder(file)}
    for folder, files in found.items():
        files |= dict.fromkeys(unwritten_in(folder))
    return {folder: list(files) for folder, files in found.items()}


def _home(folder: Path, files: Iterable[Path], target: Path) -> Path:
    """Where in `target` the files of `folder` go: a folder of the same name, with a number where other files have the
    names or it leads out of `target`."""
    files, name = list(files), folder.name or "human"
    numbered = (target / f"{name}_{number}" for number in itertools.count(2))
    return next(home for home in itertools.chain([target / name], numbered) if _is_free(home, files, target))


def _is_free(home: Path, files: Iterable[Path], target: Path) -> bool:
    try:
        check_inside(home / "file", target)
    except OutsideFolderError:
        return False
    taken = os.path.lexists(home) and not os.path.isdir(home)
    return not taken and all(_there(path, home / path.name) or not os.path.lexists(home / path.name) for path in files)


def _there(source: Path, destination: Path) -> bool:
    """Whether a copy is there already: names of volumes and bodies identify the content."""
    if not exists_in_its_folder(destination) or PERSON_FILES.fullmatch(destination.name):
        return False
    return destination.stat().st_size == source.stat().st_size


def _present(paths: Mapping[bpy.types.Volume, Path]) -> dict[bpy.types.Volume, Path]:
    """Those volumes whose file exists or will be written."""
    later = {folder for folder in {path.parent for path in paths.values()} if unwritten_in(folder)}
    return {volume: path for volume, path in paths.items() if path.parent in later or exists_in_its_folder(path)}


def _inside(path: Path, folder: Path) -> bool:
    return real_path(path).is_relative_to(real_path(folder))
