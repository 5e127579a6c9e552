"""Where the files of humans are, what they are called, and how they are copied."""

from __future__ import annotations

import filecmp
import hashlib
import os
import re
import shutil
from pathlib import Path

import bpy

TEMPORARY = "primdiffusion_humans"
"""Folder, among Blender's temporary files, for the humans of a .blend that was never saved."""
PERSON_FILE = "person.human.safetensors"
"""The human as the backend saves it, beside the volumes."""
PERSON = "primdiffusion_person_file"
"""Custom property of a human's collection: the name of the backend's file since the last edit. Undo switches it back,
as it does the paths of the volumes."""
HOME = "primdiffusion_folder"
"""Custom property of a human's collection: the absolute folder of its files when the .blend was last saved. Paths of
volumes are relative to the .blend, which may be moved alone, or opened as a copy in a temporary folder."""
PRIMITIVE_VDB = re.compile(r"prim_(\d{4,})_[0-9a-f]{12}\.vdb")
"""File names of the volumes of primitives; the hash is of the content."""
MERGED_VDB = re.compile(r"merged_[0-9a-f]{12}(_\d{4,})?\.vdb")
"""File names of merged volumes; those of a sequence end in the frame, counted from 1."""


class VolumeWriteError(OSError):
    """Files of a human could not be written; nothing was left behind."""


class MissingPersonFile(FileNotFoundError):
    """The backend's file of a human is not where it should be."""

    kind = "missing_volumes"
    """By which panels find the remedy."""


def humans_folder(blend_path: str | None = None) -> Path:
    """The folder of a .blend's humans: `<blendname>_humans` beside it, a temporary folder while it is unsaved."""
    blend = Path(blend_path if blend_path is not None else bpy.data.filepath)
    if blend.name:
        return blend.resolve().parent / f"{blend.stem}_humans"
    return Path(bpy.app.tempdir) / TEMPORARY


def stored_path(path: Path) -> str:
    """A path as a .blend should store it: relative (`//`) when the .blend is saved, else absolute."""
    if not bpy.data.filepath:
        return str(path)
    try:
        return bpy.path.relpath(str(path))
    except ValueError:  # another drive on Windows
        return str(path)


def volume_path(volume: bpy.types.Volume) -> Path:
    """The absolute path of a volume's file."""
    return Path(bpy.path.abspath(volume.filepath, library=volume.library))


def sequence_files(volume: bpy.types.Volume) -> list[Path]:
    """All files of a volume: those of a merged sequence, else the only one."""
    path = volume_path(volume)
    match = MERGED_VDB.fullmatch(path.name)
    if match is None or match[1] is None:
        return [path]
    return sorted(path.parent.glob(path.name.replace(match[1], "_*")))


def folder_of(collection: bpy.types.Collection) -> Path:
    """The folder for a human's files: `<blendname>_humans/<collection name>` (see `humans_folder`)."""
    return humans_folder() / bpy.path.clean_name(collection.name)


def folders_of(collection: bpy.types.Collection) -> list[Path]:
    """Where a human's files may be: beside the volumes wherever these are, else `folder_of`.

    Volumes keep their paths when a collection is renamed and when a .blend is saved elsewhere.
    """
    volume = next((obj.data for obj in collection.all_objects if obj.type == "VOLUME"), None)
    current = [volume_path(volume).parent] if volume is not None and volume.filepath else []
    return [*current, folder_of(collection)]


def home_of(collection: bpy.types.Collection) -> Path:
    """The folder for new files of a human: the one of its files, if that belongs to this .blend.

    Otherwise (the .blend was saved under another name, the human appended from another .blend) `folder_of`, which then
    gets all files, so that they are never in two places.
    """
    folders = folders_of(collection)
    home = next((folder for folder in folders if (folder / person_file_name(collection)).is_file()), folders[0])
    for own in (humans_folder(), humans_folder("")):
        if home.resolve().is_relative_to(own.resolve()):
            return home
    return folder_of(collection)


def person_file_name(collection: bpy.types.Collection) -> str:
    """The name of `person_file`, which each edit changes."""
    return str(collection.get(PERSON, PERSON_FILE))


def person_file(collection: bpy.types.Collection) -> Path:
    """The backend's file of a human. Raises MissingPersonFile."""
    name, folders = person_file_name(collection), folders_of(collection)
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise MissingPersonFile(
        f"the file of the person {collection.name!r} is missing: {str(folders[0] / name)!r}; put it back beside "
        "the person's volumes, press Find Missing Volumes in the panel Human, or generate the person again"
    )


def content_name(person: Path) -> str:
    """A name for the backend's file of a human that no other content has."""
    return f"person_{hashlib.sha256(person.read_bytes()).hexdigest()[:12]}.human.safetensors"


def available_name(person: Path, folder: Path, name: str) -> str:
    """The name for a copy of the backend's file in `folder`: `name`, unless another human's file has it, which undo
    may need."""
    taken = folder / name
    if not taken.is_file() or filecmp.cmp(person, taken, shallow=False):
        return name
    return content_name(person)


def copy_file(source: Path, destination: Path) -> bool:
    """Copy a file, which appears whole or not at all; returns whether it is new. Raises OSError."""
    new = not destination.exists()
    destination.parent.mkdir(parents=True, exist_ok=True)
    unfinished = destination.with_name(f".{source.name}.part")
    try:
        shutil.copyfile(source, unfinished)
        os.replace(unfinished, destination)
    finally:
        unfinished.unlink(missing_ok=True)
    return new
