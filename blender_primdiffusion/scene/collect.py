"""Copy files of humans beside the .blend, and find those that are no longer used.

Humans generated before the first save have their files in a temporary folder, which saving copies. Files of humans that
were appended, or whose .blend was saved elsewhere under another name, stay where they were until Collect Files.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..formats.regular_files import real_path
from ..formats.removing import remove_file
from .body_file import BODY_FILE, BODY_NPZ, body_files
from .human import (
    HOME,
    MARK,
    MERGED_VDB,
    PERSON,
    PRIMITIVE_VDB,
    TEMPORARY,
    UNWRITTEN_NPZ,
    VolumeWriteError,
    available_name,
    copy_file,
    folders_of,
    humans_folder,
    person_file_name,
    sequence_files,
    stored_path,
    unwritten_in,
    volume_path,
)

_PERSON_FILES = re.compile(r"person(_[0-9a-f]{12})?\.human\.safetensors")
_OURS = (PRIMITIVE_VDB, _PERSON_FILES, BODY_NPZ, MERGED_VDB, UNWRITTEN_NPZ)


@dataclasses.dataclass(frozen=True)
class Collected:
    """What was copied."""

    volumes: int
    """Volumes that show another file now."""
    files: int
    """Files that did not exist before."""
    size: int
    """Bytes of these files."""


def collect_temporary_volumes(blend_path: str) -> Collected:
    """Copy files of humans from temporary folders to the folder of `blend_path`, and point to the copies.

    Includes temporary folders of an earlier Blender that has crashed. Files that the .blend does not use stay, for
    undo. In a .blend never saved, paths become absolute: Blender makes them relative when it first writes it. Raises
    VolumeWriteError when the folder beside the .blend cannot be written.
    """
    return _collect(blend_path, [volume for volume in _local() if _temporary(volume_path(volume))])


def collect_files() -> Collected:
    """Copy all files of this .blend's humans beside it, and point to the copies; files of linked humans stay.

    Raises ValueError for a .blend that was never saved, FileNotFoundError where files are missing, and VolumeWriteError
    where they cannot be written; then nothing has changed.
    """
    if not bpy.data.filepath:
        raise ValueError("this file was never saved: save it first, which collects the files of its humans too")
    home = humans_folder()
    away = [volume for volume in _local() if not _inside(volume_path(volume), home)]
    present = _present(away)
    gone = [volume for volume in away if volume not in present]
    if gone:
        raise FileNotFoundError(
            f"{len(gone)} volumes have lost their files, {str(volume_path(gone[0]))!r} among them: press Find Missing "
            "Volumes in the panel Human first"
        )
    return _collect(bpy.data.filepath, away)


def store_folders() -> None:
    """Store with each human where its files are, in case the .blend is moved without them."""
    for person in bpy.data.collections:
        if MARK in person and person.library is None:
            home = folders_of(person)[0]
            if home.is_dir() and person.get(HOME) != str(home):
                person[HOME] = str(home)


@persistent
def collect_before_saving(blend_path: str, *_: object) -> None:
    """Handler of save_pre. After a failure, which is printed, the .blend is saved pointing to the temporary files."""
    if not blend_path:  # the start-up file
        return
    try:
        collect_temporary_volumes(blend_path)
    except OSError as error:
        print(
            f"PrimDiffusion: volumes stay in {humans_folder('')}: they could not be copied beside the .blend ({error})"
        )
    store_folders()


def unused(folder: Path) -> list[Path]:
    """Files in `folder`, of earlier states of humans, that nothing in the current .blend points to.

    Undo may still need them, and so may other .blend files that share the folder.
    """
    if not folder.is_dir():
        return []
    used = {real_path(path) for volume in bpy.data.volumes if volume.filepath for path in sequence_files(volume)}
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


def _local() -> list[bpy.types.Volume]:
    """Volumes of humans in this .blend that are not linked."""
    shown = {
        obj.data: None
        for person in bpy.data.collections
        if MARK in person
        for obj in person.all_objects
        if obj.type == "VOLUME" and obj.data.filepath
    }
    return [volume for volume in shown if volume.library is None]


def _collect(blend_path: str, away: Iterable[bpy.types.Volume]) -> Collected:
    target = humans_folder(blend_path)
    sources = _present(away)
    moved = {volume: target / path.parent.name / path.name for volume, path in sources.items()}
    copies = {path: moved[volume].parent / path.name for volume in moved for path in sequence_files(volume)}
    copies = {source: copy for source, copy in copies.items() if source.is_file()}
    for folder in {path.parent for path in sources.values()}:
        copies |= {path: target / folder.name / path.name for path in unwritten_in(folder)}
    names = {}
    for person in bpy.data.collections:
        if MARK in person and person.library is None:
            copies |= _of_person(person, moved, target, names)
    made: list[Path] = []
    try:
        for source, destination in copies.items():
            there = destination.is_file() and destination.stat().st_size == source.stat().st_size
            if not there and copy_file(source, destination):  # names of volumes and bodies identify the content
                made.append(destination)
    except OSError as error:
        for path in made:
            remove_file(path, path.parent)
        raise VolumeWriteError(
            f"the files of humans could not be copied to {str(target)!r} ({error}); save the .blend in a folder with "
            "write permission and free space"
        ) from error
    for volume, path in moved.items():
        volume.filepath = stored_path(path)
    for person, name in names.items():
        person[PERSON] = name
    return Collected(len(moved), len(made), sum(path.stat().st_size for path in made))


def _of_person(
    person: bpy.types.Collection,
    moved: dict[bpy.types.Volume, Path],
    target: Path,
    names: dict[bpy.types.Collection, str],
) -> dict[Path, Path]:
    """Copies of the backend's and the body's file to where the human's volumes go; new names are added to `names`."""
    near = folders_of(person)
    volume = next((obj.data for obj in person.all_objects if obj.type == "VOLUME"), None)
    if volume not in moved:
        return {}
    home, copies = moved[volume].parent, {}
    file = next((path for path in (folder / person_file_name(person) for folder in near) if path.is_file()), None)
    if file is not None and file.parent != home:
        name = available_name(file, home, file.name)
        copies[file] = home / name
        if name != person_file_name(person):
            names[person] = name
    body = str(person.get(BODY_FILE, ""))
    paths = [parent / body for folder in near for parent in (folder.parent, folder)] if body else []
    found = next((path for path in paths if path.is_file()), None)
    if found is not None:
        copies[found] = target / body
    return copies


def _present(volumes: Iterable[bpy.types.Volume]) -> dict[bpy.types.Volume, Path]:
    """The paths of those volumes whose file exists or will be written."""
    paths = {volume: volume_path(volume) for volume in volumes}
    later = {folder for folder in {path.parent for path in paths.values()} if unwritten_in(folder)}
    return {volume: path for volume, path in paths.items() if path.parent in later or path.is_file()}


def _temporary(path: Path) -> bool:
    """Whether a file is among the temporary files of this Blender, or of one that has crashed."""
    return any(folder.name == TEMPORARY and folder.parent.name.startswith("blender_") for folder in path.parents) or (
        _inside(path, humans_folder(""))
    )


def _inside(path: Path, folder: Path) -> bool:
    return real_path(path).is_relative_to(real_path(folder))
