"""Volumes that are still to be written: those that a human has in the scene and whose files are absent, or in a format
that only a newer Blender can read.

They are written from the human's own file, in folders of this .blend alone, to which `collect.collect_pending` brings
humans from elsewhere. Any Blender can write them, in steps and after any interruption. Until it is closed, Blender
remembers the paths that it could not read, so files of newer formats have to be written before viewports try.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Sequence
from pathlib import Path

import bpy

from ..formats.regular_files import exists_in_its_folder
from ..formats.whole_files import remove_abandoned
from .attachment import attachment_of, in_viewport
from .human import MARK, PERSON_FILE, PRIMITIVE_VDB, is_own, state_folder, volume_name, volume_path, write_error
from .rest_human import read_human
from .volumes import format_of, is_readable, readable_format, reload_volume, write_volume


@dataclasses.dataclass(frozen=True)
class PendingVolumes:
    """Volumes of one human in its folder. Holds no Blender objects, since undo may replace them."""

    human: str
    """Name of the human's collection."""
    folder: Path
    """The folder of the human's state."""
    primitives: tuple[int, ...]
    """The primitives whose volumes the human has, in the order in which they are written."""
    newer: int | None
    """The format version of a newer Blender in which they are; None where they are absent."""
    in_views: bool
    """Viewports read them."""


def pending_volumes() -> list[PendingVolumes]:
    """What all humans of the .blend have of such volumes, in its own folders.

    Without humans whose own file is missing. Lists each folder, and reads the headers of two volumes in it.
    """
    every = (pending_of(person) for person in bpy.data.collections if MARK in person)
    return [one for one in every if one is not None and is_own(one.folder)]


def pending_of(person: bpy.types.Collection) -> PendingVolumes | None:
    """What one human has of such volumes, wherever it is; None where that is nothing, its own file is missing, or
    splats show it."""
    if attachment_of(person) == "SPLATS":
        return None
    folder = state_folder(person)
    if not exists_in_its_folder(folder / PERSON_FILE):
        return None
    paths = {volume_path(obj.data) for obj in person.all_objects if obj.type == "VOLUME"}
    names = (PRIMITIVE_VDB.fullmatch(path.name) for path in paths if path is not None and path.parent == folder)
    shown = sorted(int(name[1]) for name in names if name is not None)
    there = {path.name for path in folder.glob("prim_*.vdb")}
    absent = [k for k in shown if volume_name(k) not in there]
    ends = [folder / volume_name(k) for k in (shown[:1] + shown[-1:]) if k not in absent]  # written first and last
    formats = [version for path in ends if (version := format_of(path) or 0) > readable_format()]
    if not (absent or formats):
        return None
    in_views = in_viewport(person) or _instanced(person)
    return PendingVolumes(person.name, folder, tuple(shown), max(formats, default=None), in_views)


def is_wanted(pending: PendingVolumes) -> bool:
    """Whether a human of the .blend is still in this state."""
    return any(MARK in person and state_folder(person) == pending.folder for person in bpy.data.collections)


def _instanced(person: bpy.types.Collection) -> bool:
    """Whether an object instances the human: viewports then read its volumes, hidden or not."""
    instanced = {obj.instance_collection for obj in bpy.data.objects if obj.instance_type == "COLLECTION"} - {None}
    return any(person == collection or person in collection.children_recursive for collection in instanced)


def write_pending(pending: PendingVolumes) -> Generator[None, None, None]:
    """Write these volumes, a file a step; those that can be read by now stay.

    Several may write the same volumes, as a timer and a render do. Raises as `read_human`, also for what cannot be
    written, and ValueError for a human with fewer primitives.
    """
    folder = pending.folder
    human = read_human(folder / PERSON_FILE)
    yield
    if max(pending.primitives) >= len(human.payload.density):
        raise ValueError(
            f"the volumes of {pending.human!r} cannot be written from {str(folder / PERSON_FILE)!r}, which holds "
            "another human: put its own file back, or generate the human again"
        )
    grids = human.grids()
    yield
    remove_abandoned(folder)
    for k in pending.primitives:
        path = folder / volume_name(k)
        try:
            if not is_readable(path):
                write_volume(grids, k, path)
        except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
            raise write_error(folder, error) from error
        yield


def write_all_pending() -> None:
    """Write all of them, which takes seconds for each human. Raises as `write_pending`."""
    for pending in pending_volumes():
        for _ in write_pending(pending):
            pass


def show_written() -> None:
    """Have Blender show the volumes that it has looked for before they were written."""
    for volume in bpy.data.volumes:
        path = volume_path(volume) if volume.grids.error_message else None
        if path is not None and exists_in_its_folder(path):
            reload_volume(volume)


def newer_text(pending: Sequence[PendingVolumes]) -> str:
    """What is written again, and why: a sentence."""
    names, newest = ", ".join(repr(one.human) for one in pending), max(one.newer or 0 for one in pending)
    return (
        f"volumes of {names:.120} are in a format of a newer Blender ({newest}; this one reads up to "
        f"{readable_format()}): they are written again from the human's own file"
    )
