"""Keep the files of a .blend's humans in its own folder, and find those that are no longer used.

Whatever is saved has all files of its humans in `humans_folder` of its own name: those from a temporary folder, from
the .blend that it was saved from under another name, and of appended humans. So no .blend depends on another one's
folder, except those that link humans from it. What is copied are whole folders of states.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
from collections.abc import Sequence
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..formats.regular_files import FileError, exists_in_its_folder, portable_name, printable, real_path, remove_file
from ..formats.whole_files import remove_empty
from .blend_values import as_shown, stored_folder, stored_text
from .earlier_files import EARLIER, earlier_volumes
from .human import (
    BODY_FILE,
    HOME,
    MARK,
    MERGED_VDB,
    PERSON_FILE,
    PRIMITIVE_VDB,
    STATE,
    copy_file,
    humans_folder,
    is_own,
    note_state,
    same_file,
    sequence_files,
    state_folder,
    stored_path,
    volume_path,
    was_newest,
    write_error,
)
from .pending import pending_of
from .volumes import reload_volume


@dataclasses.dataclass(frozen=True)
class Collected:
    """What was copied."""

    humans: int
    """Humans whose files are in another folder now."""
    files: int
    """Files that did not exist before."""
    size: int
    """Bytes of these files."""


@dataclasses.dataclass
class _Changes:
    """What collecting has changed, to be taken back where the file that is written is not the open one."""

    paths: dict[bpy.types.Volume, str] = dataclasses.field(default_factory=dict)
    """Paths of volumes before."""
    homes: dict[bpy.types.Collection, str | None] = dataclasses.field(default_factory=dict)
    """HOME of humans before; None where none was stored."""
    made: list[Path] = dataclasses.field(default_factory=list)
    """Files that did not exist before."""
    target: Path | None = None
    """The folder of humans in which they are."""

    def remove_made(self) -> None:
        for path in self.made:
            with contextlib.suppress(OSError):
                remove_file(path, path.parent)
        if self.target is not None:
            states = {path.parent for path in self.made}
            remove_empty([*states, *({state.parent for state in states} - {self.target}), self.target])
        self.made.clear()

    def take_back(self) -> None:
        for volume, path in self.paths.items():
            volume.filepath = path
        for person, home in self.homes.items():
            if home is None:
                del person[HOME]
            else:
                person[HOME] = home
        self.forget()

    def forget(self) -> None:
        self.paths.clear()
        self.homes.clear()
        self.made.clear()


_saving = _Changes()
"""Of the file that is being saved."""


def collect_own_files(blend_path: str) -> Collected:
    """Copy the folders of humans from elsewhere to the folder of `blend_path`, and point to the copies.

    Elsewhere are temporary folders, also those of an earlier Blender that has crashed, and the folders of other .blend
    files. Missing files are left out, and folders of states that the .blend does not use stay, for undo. In a .blend
    never saved, paths become absolute: Blender makes them relative when it first writes it. Raises FileError when
    the folder beside the .blend cannot be written.
    """
    return _collect(blend_path, _own_humans(), _saving)


def collect_pending() -> Collected:
    """Copy the folders of humans elsewhere, whose volumes are still to be written, to the temporary folder of this
    Blender, and point to the copies: they are written there. Linked humans are among them, in this session.

    Raises FileError.
    """
    elsewhere = (person for person in bpy.data.collections if MARK in person and not is_own(state_folder(person)))
    return _collect("", [person for person in elsewhere if pending_of(person) is not None], _Changes())


def collect_files() -> Collected:
    """Copy all files of this .blend's humans beside it, and point to the copies; files of linked humans stay.

    Raises ValueError for a .blend that was never saved, FileNotFoundError where files are missing, and FileError
    where they cannot be written; then nothing has changed.
    """
    if not bpy.data.filepath:
        raise ValueError("this file was never saved: save it first, which collects the files of its humans too")
    people = _own_humans()
    gone = [person for person in people if not exists_in_its_folder(state_folder(person) / PERSON_FILE)]
    if gone:
        raise FileNotFoundError(
            f"{len(gone)} humans have lost their files, {gone[0].name!r} among them: press Find Missing Volumes in the "
            "panel Human first"
        )
    return _collect(bpy.data.filepath, people, _Changes())


@persistent
def collect_before_saving(blend_path: str, *_: object) -> None:
    """Handler of save_pre. After a failure, which is printed, the .blend is saved pointing to where the files were."""
    _saving.forget()
    if not os.path.isdir(os.path.dirname(blend_path)):  # the start-up file has no path; others cannot be written
        return
    for fault in ignored_values():
        print(printable(f"PrimDiffusion: {fault}"))
    try:
        collect_own_files(blend_path)
    except (OSError, FileError) as error:
        print(printable(f"PrimDiffusion: humans of this file depend on files elsewhere: {error}"))


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
    """Paths that this .blend stores with its humans and that no file of a human can have, each in a sentence. They
    count as missing."""
    found = []
    for person in _own_humans():
        if HOME in person and stored_folder(person, HOME) is None:
            found.append(
                f"the custom property {HOME!r} of {as_shown(person.name)!r} is ignored: it does not name what it should"
            )
        volumes = {obj.data for obj in person.all_objects if obj.type == "VOLUME" and obj.data.filepath}
        if strange := sorted(volume.name for volume in volumes if volume_path(volume) is None):
            found.append(
                f"the volume {as_shown(strange[0])!r} of {as_shown(person.name)!r}, one of {len(strange)}, is ignored: "
                "its path is not one of a human's volume"
            )
    return found


def unused(folder: Path) -> list[Path]:
    """Files in `folder`, of earlier states of humans, that nothing in the current .blend points to.

    Undo may still need them, and so may other .blend files that share the folder. None while a human could not be
    converted from the earlier layout.
    """
    if not folder.is_dir() or earlier_volumes():
        return []
    states = {real_path(state_folder(person)) for person in bpy.data.collections if MARK in person}
    merged = {real_path(path) for volume in bpy.data.volumes for path in sequence_files(volume)}
    ours = [path for path in sorted(folder.rglob("*")) if _is_ours(path)]
    return [path for path in ours if real_path(path.parent) not in states and real_path(path) not in merged]


def _is_ours(path: Path) -> bool:
    in_state = path.name in (PERSON_FILE, BODY_FILE) or PRIMITIVE_VDB.fullmatch(path.name) is not None
    return (in_state and STATE.fullmatch(path.parent.name) is not None) or any(
        pattern.fullmatch(path.name) for pattern in (MERGED_VDB, *EARLIER)
    )


def _own_humans() -> list[bpy.types.Collection]:
    """The humans of this .blend that are not linked."""
    return [person for person in bpy.data.collections if MARK in person and person.library is None]


def _collect(blend_path: str, people: Sequence[bpy.types.Collection], changes: _Changes) -> Collected:
    """Copy the folders of these humans, and their merged volumes; what changes is added to `changes`."""
    changes.target = target = humans_folder(blend_path)
    homes: dict[Path, Path] = {}
    states = {person: folder for person in people if os.path.isdir(folder := state_folder(person))}
    merged = {volume: path for person in people for volume, path in _merged_of(person).items()}
    try:
        for person, folder in states.items():
            if folder not in homes:
                homes[folder] = folder if _inside(folder, target) else _copied_state(folder, person, changes)
        outside = {volume: path for volume, path in merged.items() if not _inside(path, target)}
        moved = {volume: _copied_merged(volume, path, changes) for volume, path in outside.items()}
    except (OSError, FileError) as error:
        changes.remove_made()
        raise write_error(target, error) from error
    for person, folder in states.items():
        volumes = {obj.data for obj in person.all_objects if obj.type == "VOLUME"}
        paths = {volume: path for volume in volumes if (path := volume_path(volume)) is not None}
        moved |= {volume: homes[folder] / path.name for volume, path in paths.items() if path.parent == folder}
        if person.library is None:
            changes.homes[person] = stored_text(person, HOME)
            person[HOME] = str(homes[folder])
    for volume, path in moved.items():
        if volume_path(volume) != path:
            changes.paths[volume] = volume.filepath
            volume.filepath = stored_path(path) if blend_path else str(path)
            if volume.grids.error_message:  # its file was missing, and was written since
                reload_volume(volume)
    count = sum(folder != homes[folder] for folder in states.values())
    return Collected(count, len(changes.made), sum(path.stat().st_size for path in changes.made))


def _copied_state(folder: Path, person: bpy.types.Collection, changes: _Changes) -> Path:
    """Copy the folder of a human's state, under the same names where these are free; returns the copy."""
    home = changes.target / portable_name(bpy.path.clean_name(folder.parent.name or person.name))
    first = int(folder.name) if STATE.fullmatch(folder.name) else 1
    numbered = (home / f"{number:04d}" for number in itertools.count(first))
    state = next(state for state in numbered if _is_free(state, folder))
    note_state(state)
    volumes = (path.name for path in sorted(folder.glob("prim_*.vdb")) if PRIMITIVE_VDB.fullmatch(path.name))
    for name in (PERSON_FILE, BODY_FILE, *volumes):
        _copy(folder / name, state / name, changes)
    return state


def _is_free(state: Path, folder: Path) -> bool:
    """Whether `state` can become the copy of a folder: it is new, or holds nothing but the same human."""
    if not os.path.lexists(state):
        return int(state.name) > was_newest(state.parent)
    return same_file(folder / PERSON_FILE, state / PERSON_FILE) and not any(map(os.path.islink, state.iterdir()))


def _copied_merged(volume: bpy.types.Volume, path: Path, changes: _Changes) -> Path:
    """Copy the files of a merged volume, under the same names; returns the copy of `path`."""
    home = changes.target / portable_name(bpy.path.clean_name(path.parent.name))
    for file in sequence_files(volume):
        _copy(file, home / file.name, changes)
    return home / path.name


def _copy(source: Path, destination: Path, changes: _Changes) -> None:
    """Copy a file that exists; one that is there already stays: the folder tells what is in it."""
    new = exists_in_its_folder(source) and not exists_in_its_folder(destination)
    if new and copy_file(source, destination, changes.target, may_link=True):
        changes.made.append(destination)


def _merged_of(person: bpy.types.Collection) -> dict[bpy.types.Volume, Path]:
    """Volumes of a human that show a merged file and are not linked, and their paths."""
    volumes = {obj.data for obj in person.all_objects if obj.type == "VOLUME" and obj.data.library is None}
    paths = {volume: volume_path(volume) for volume in volumes}
    return {volume: path for volume, path in paths.items() if path is not None and MERGED_VDB.fullmatch(path.name)}


def _inside(path: Path, folder: Path) -> bool:
    return real_path(path).is_relative_to(real_path(folder))
