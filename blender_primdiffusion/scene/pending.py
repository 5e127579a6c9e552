"""Volumes for Cycles and EEVEE that are still to be written: those that a human has in the scene, without their files.

They are written from the human's own file, beside it in the temporary folder of this session (see `payload`), in steps
and after any interruption. A .blend that comes from another session, or from a stranger, names folders of its own: its
volumes are pointed to that folder before anything is read.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Generator
from pathlib import Path

import bpy

from ..formats.whole_files import remove_abandoned
from .attachment import attachment_of
from .human import all_humans, body_of, primitive_of, volume_name, volumes_of, write_error
from .payload import session_file, state_of
from .rest_human import read_human, shape_model_of
from .volumes import reload_volume, write_volume


@dataclasses.dataclass(frozen=True)
class PendingVolumes:
    """Volumes of one human. Holds no Blender objects, since undo may replace them."""

    human: str
    """The human's name."""
    file: Path
    """The human's own file."""
    primitives: tuple[int, ...]
    """The primitives whose volumes the human has, in the order in which they are written."""


def open_humans() -> list[str]:
    """Point the volumes of all humans to the files of this session; returns what is wrong with humans, in sentences.

    For files that were opened and humans that were appended or linked, before undo takes note of them. A human whose
    data are missing or damaged shows its body mesh.
    """
    faults = []
    for person in all_humans():
        try:
            folder = session_file(person).parent
            shape_model_of(person)
        except (ValueError, OSError) as error:
            faults.append(f"the human {person.name!r} cannot be drawn: {error}")
            if (body := body_of(person)) is not None:
                body.hide_viewport = False
            continue
        for volume in {obj.data for objects in volumes_of(person).values() for obj in objects}:
            show_volume(volume, folder)
    return faults


def show_volume(volume: bpy.types.Volume, folder: Path) -> None:
    """Have a volume of a primitive show its file in this folder."""
    path = str(folder / volume_name(primitive_of(volume)))
    if volume.filepath != path:
        volume.filepath = path


def pending_volumes() -> list[PendingVolumes]:
    """What all humans of the .blend have of such volumes; without humans that cannot be read."""
    every = map(pending_of, all_humans())
    return [one for one in every if one is not None]


def pending_of(person: bpy.types.Object) -> PendingVolumes | None:
    """What one human has of such volumes; None for nothing, and for a human that cannot be read or that splats show."""
    if attachment_of(person) == "SPLATS":
        return None
    try:
        file = session_file(person)
    except (ValueError, OSError):
        return None
    there = {path.name for path in file.parent.glob("prim_*.vdb")}
    shown = sorted(volumes_of(person))
    absent = [k for k in shown if volume_name(k) not in there]
    return PendingVolumes(person.name, file, tuple(shown)) if absent else None


def is_wanted(pending: PendingVolumes) -> bool:
    """Whether a human of the .blend is still in this state."""
    return any(state_of(person) == pending.file.parent.name for person in all_humans())


def write_pending(pending: PendingVolumes) -> Generator[None, None, None]:
    """Write these volumes, a file a step; those that are there stay.

    Several may write the same volumes, as a timer and a render do. Raises as `read_human`, also for what cannot be
    written, and ValueError for a human with fewer primitives.
    """
    human = read_human(pending.file)
    yield
    if max(pending.primitives) >= len(human.payload.density):
        raise ValueError(f"{pending.human!r} has more volumes than its data has primitives: generate the human again")
    grids = human.grids()
    yield
    folder = pending.file.parent
    remove_abandoned(folder)
    for k in pending.primitives:
        path = folder / volume_name(k)
        try:
            if not path.is_file():
                write_volume(grids, k, path)
        except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
            raise write_error(folder, error) from error
        yield


def write_volumes(person: bpy.types.Object) -> None:
    """Write those of one human, which takes seconds. Raises as `write_pending`."""
    pending = pending_of(person)
    for _ in write_pending(pending) if pending is not None else ():
        pass


def write_all_pending() -> None:
    """Write all of them. Raises as `write_pending`."""
    for pending in pending_volumes():
        for _ in write_pending(pending):
            pass


def show_written() -> None:
    """Have Blender show the volumes that it has looked for before they were written."""
    for volume in bpy.data.volumes:
        if volume.grids.error_message and primitive_of(volume) is not None and Path(volume.filepath).is_file():
            reload_volume(volume)
