"""Volumes that a newer Blender has written in a format that this one cannot read: written again.

From the human's own file, in the same place, so that older and newer Blenders can read the result: in folders of this
.blend alone, to which `collect.collect_unwritten` brings humans from elsewhere. Until it is closed, Blender remembers
the paths that it could not read, so files that viewports read have to be written before they try.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Sequence
from pathlib import Path

import bpy
import numpy as np

from .attachment import in_viewport
from .body_file import body_file, read_body_file
from .human import MARK, MissingPersonFile, is_own, person_file, volume_path, volumes_of
from .human_file import read_payload
from .vdb import readable_format
from .volumes import bake, format_of, is_readable, write_error, write_one

_WRITTEN_AS = (5, 0, 0)
"""The version of Blender by which grids are placed: formats that older ones cannot read came later."""


@dataclasses.dataclass(frozen=True)
class NewerVolumes:
    """Volumes of one human. Holds no Blender objects, since undo may replace them."""

    person: str
    """Name of the human's collection."""
    own: Path
    """The human's own file."""
    body: Path | None
    """The file of its body."""
    files: tuple[tuple[int, Path], ...]
    """The primitive and the path of each."""
    format: int
    """The newest format version among them."""
    in_views: bool
    """Viewports read them."""


def newer_volumes() -> list[NewerVolumes]:
    """What all humans of the .blend have of such volumes, without humans whose own file is missing.

    Reads the headers of all volumes, some 50 ms for a human.
    """
    formats: dict[Path, int] = {}
    every = (_newer_of(person, formats) for person in bpy.data.collections if MARK in person)
    return [newer for newer in every if newer is not None]


def _newer_of(person: bpy.types.Collection, formats: dict[Path, int]) -> NewerVolumes | None:
    """What one human has of such volumes; `formats` keeps what headers say."""
    shown = {(k, volume_path(obj.data)) for k, objects in volumes_of(person).items() for obj in objects}
    own_folders = {folder for folder in {path.parent for _, path in shown if path is not None} if is_own(folder)}
    files = sorted((k, path) for k, path in shown if path is not None and path.parent in own_folders)
    for _, path in files:
        if path not in formats:
            formats[path] = format_of(path) or 0
    newer = tuple((k, path) for k, path in files if formats[path] > readable_format())
    if not newer:
        return None
    try:
        own = person_file(person)
    except MissingPersonFile:
        return None
    newest = max(formats[path] for _, path in newer)
    return NewerVolumes(person.name, own, body_file(person), newer, newest, in_viewport(person) or _instanced(person))


def _instanced(person: bpy.types.Collection) -> bool:
    """Whether an object instances the human: viewports then read its volumes, hidden or not."""
    instanced = {obj.instance_collection for obj in bpy.data.objects if obj.instance_type == "COLLECTION"} - {None}
    return any(person == collection or person in collection.children_recursive for collection in instanced)


def write_again(newer: NewerVolumes) -> Generator[None, None, None]:
    """Write these volumes, a file a step; those that can be read by now stay.

    Raises ValueError for an own file that does not tell what they hold, OSError, and VolumeWriteError.
    """
    payload, extent = read_payload(newer.own), None
    if payload.rest_half_extent is not None:
        extent = payload.rest_half_extent
    elif newer.body is not None:
        extent = read_body_file(newer.body).rest_half_extent
    count = len(payload.density)
    if extent is None or len(extent) != count or max(k for k, _ in newer.files) >= count:
        raise ValueError(
            f"the volumes of {newer.person!r} have the newer format {newer.format} and cannot be written again from "
            f"{newer.own.name!r}, which is of an earlier version or of another human: open the file in the Blender "
            "that wrote them, or generate the human again"
        )
    yield
    colour = np.moveaxis(payload.rgb, 1, -1)
    grids = bake(payload.density, colour, np.asarray(extent, np.float64) * payload.delta_scale)
    yield
    for k, path in newer.files:
        try:
            if not is_readable(path):
                write_one(grids, k, _WRITTEN_AS, path)
        except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
            raise write_error(path.parent, error) from error
        yield


def in_a_sentence(newer: Sequence[NewerVolumes]) -> str:
    """What is written again, and why."""
    count, names = sum(len(one.files) for one in newer), ", ".join(repr(one.person) for one in newer)
    return (
        f"{count} volumes of {names:.120} are in a format of a newer Blender ({max(one.format for one in newer)}; this "
        f"one reads up to {readable_format()}): they are written again from the human's own file"
    )
