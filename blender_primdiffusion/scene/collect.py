"""Files of people brought beside the .blend: by itself from the temporary folder of one never saved, else when asked.

People generated before the first save have their files in a temporary folder; saving brings them along. Those that were
appended, or saved under another name elsewhere, keep theirs where they were until Collect Files.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from .files import (
    HOME,
    MERGED_VDB,
    PERSON,
    PRIMITIVE_VDB,
    TEMPORARY,
    VolumeWriteError,
    folders_of,
    free_name,
    humans_folder,
    person_file_name,
    put_copy,
    sequence_files,
    stored_path,
    volume_path,
)
from .human import MARK
from .shape import BODY_FILE, BODY_NPZ, body_files

_PERSON = re.compile(r"person(_[0-9a-f]{12})?\.human\.safetensors")


@dataclasses.dataclass(frozen=True)
class Collected:
    """What was brought."""

    volumes: int
    """That show another file now."""
    files: int
    """That were not there before."""
    size: int
    """Of these, bytes."""


def collect_temporary_volumes(blend_path: str) -> Collected:
    """Copy files of people from temporary folders to the folder of `blend_path`, and point to the copies.

    Temporary folders of an earlier Blender, after a crash, count too. What the .blend does not use stays behind, for
    undo. In a .blend never saved paths become absolute: Blender makes them relative when it first writes it. Raises
    VolumeWriteError when the folder beside the .blend cannot be written.
    """
    return _collect(blend_path, [volume for volume in _local() if _temporary(volume_path(volume))])


def collect_files() -> Collected:
    """Copy all files of this .blend's people beside it, and point to the copies; those linked stay where they are.

    Raises ValueError for a .blend that was never saved, FileNotFoundError where files are missing, and VolumeWriteError
    where they cannot be written; then nothing is changed.
    """
    if not bpy.data.filepath:
        raise ValueError("this file was never saved: save it first, which collects the files of its people too")
    home = humans_folder()
    away = [volume for volume in _local() if not _inside(volume_path(volume), home)]
    gone = [volume for volume in away if not volume_path(volume).is_file()]
    if gone:
        raise FileNotFoundError(
            f"{len(gone)} volumes have lost their files, {str(volume_path(gone[0]))!r} among them: press Find Missing "
            "Volumes in the panel Human first"
        )
    return _collect(bpy.data.filepath, away)


def note_folders() -> None:
    """Keep on each person where their files are now, for the day when the .blend is moved without them."""
    for person in bpy.data.collections:
        if MARK in person and person.library is None:
            home = folders_of(person)[0]
            if home.is_dir() and person.get(HOME) != str(home):
                person[HOME] = str(home)


@persistent
def collect_before_saving(blend_path: str, *_: object) -> None:
    """Handler of save_pre. After a failure, printed, the .blend is saved pointing to the temporary files."""
    if not blend_path:  # the start-up file
        return
    try:
        collect_temporary_volumes(blend_path)
    except OSError as error:
        print(
            f"PrimDiffusion: volumes stay in {humans_folder('')}: they could not be copied beside the .blend ({error})"
        )
    note_folders()


def unused(folder: Path) -> list[Path]:
    """Files of people in `folder` that nothing in the .blend, as it is now, points to: of earlier states of people.

    Undo may still want them, and so may other .blend files that share the folder.
    """
    if not folder.is_dir():
        return []
    used = {path.resolve() for volume in bpy.data.volumes if volume.filepath for path in sequence_files(volume)}
    kept = people_files() | body_files()
    found = []
    for path in sorted(folder.rglob("*")):
        of_people = any(pattern.fullmatch(path.name) for pattern in (PRIMITIVE_VDB, _PERSON, BODY_NPZ, MERGED_VDB))
        if of_people and path.name not in kept and path.resolve() not in used:
            found.append(path)
    return found


def people_files() -> set[str]:
    """Names of the backend's files that people of this .blend use, those linked included."""
    return {person_file_name(collection) for collection in bpy.data.collections if MARK in collection}


def _local() -> list[bpy.types.Volume]:
    """Volumes of people that live in this .blend."""
    shown = {
        thing.data: None
        for person in bpy.data.collections
        if MARK in person
        for thing in person.all_objects
        if thing.type == "VOLUME" and thing.data.filepath
    }
    return [volume for volume in shown if volume.library is None]


def _collect(blend_path: str, away: Iterable[bpy.types.Volume]) -> Collected:
    target = humans_folder(blend_path)
    moved = {}
    for volume in away:
        source = volume_path(volume)
        if source.is_file():
            moved[volume] = target / source.parent.name / source.name
    copies = {path: moved[volume].parent / path.name for volume in moved for path in sequence_files(volume)}
    names = {}
    for person in bpy.data.collections:
        if MARK in person and person.library is None:
            copies |= _of_person(person, moved, target, names)
    made: list[Path] = []
    try:
        for source, destination in copies.items():
            there = destination.is_file() and destination.stat().st_size == source.stat().st_size
            if not there and put_copy(source, destination):  # of volumes and bodies, the name tells the content
                made.append(destination)
    except OSError as error:
        for path in made:
            path.unlink(missing_ok=True)
        raise VolumeWriteError(
            f"the files of people could not be copied to {str(target)!r} ({error}); save the .blend in a folder with "
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
    """Copies of the backend's file and the body's, where the person's volumes go; other names needed go to `names`."""
    near = folders_of(person)
    volume = next((thing.data for thing in person.all_objects if thing.type == "VOLUME"), None)
    if volume not in moved:
        return {}
    home, copies = moved[volume].parent, {}
    file = next((path for path in (folder / person_file_name(person) for folder in near) if path.is_file()), None)
    if file is not None and file.parent != home:
        name = free_name(file, home, file.name)
        copies[file] = home / name
        if name != person_file_name(person):
            names[person] = name
    body = str(person.get(BODY_FILE, ""))
    places = [place / body for folder in near for place in (folder.parent, folder)] if body else []
    found = next((path for path in places if path.is_file()), None)
    if found is not None:
        copies[found] = target / body
    return copies


def _temporary(path: Path) -> bool:
    """Among the temporary files of this Blender, or of one that has crashed."""
    return any(folder.name == TEMPORARY and folder.parent.name.startswith("blender_") for folder in path.parents) or (
        _inside(path, humans_folder(""))
    )


def _inside(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())
