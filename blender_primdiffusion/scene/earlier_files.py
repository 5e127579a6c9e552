"""Humans whose files are named by hashes, as before folders of states: read once, when a .blend with them is opened.

    NAME_humans/body_<hash>.npz
    NAME_humans/Human/person.human.safetensors, person_<hash>.human.safetensors after an edit
    NAME_humans/Human/prim_0007_<hash>.vdb, or unwritten_<hash>.npz from which these were still to be written

`convert` gives each of them a folder of a state (see `states`) in this Blender's temporary folder, with hard links to
the files or copies, and saving collects it from there. The earlier files stay, for the .blend as it is on the disk,
until the user removes unused files.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import bpy
from numpy.typing import NDArray

from ..formats.arrays import MOST_BODY_VALUES, read_numbers
from ..formats.regular_files import FileError, exists_in_its_folder, portable_name, printable
from .blend_values import file_path, stored_name
from .human import (
    BODY_FILE,
    HOME,
    MARK,
    PERSON_FILE,
    copy_file,
    humans_folder,
    new_state,
    remove_state,
    volume_name,
    write_error,
)
from .human_file import read_tensors, write_body
from .shape import FIELDS

_PERSON, _BODY = "primdiffusion_person_file", "primdiffusion_body_file"
"""Custom properties of collections: names of the human's own file and of its body's."""
_PERSON_FILE = re.compile(r"person(_[0-9a-f]{12})?\.human\.safetensors")
_BODY_FILE = re.compile(r"body_[0-9a-f]{12}\.npz")
_VOLUME = re.compile(r"prim_([0-9]{4,6})_[0-9a-f]{12}\.vdb")
EARLIER = (_PERSON_FILE, _BODY_FILE, _VOLUME, re.compile(r"unwritten_[0-9a-f]{12}\.npz"))
"""File names of this layout."""


def convert_earlier() -> None:
    """Give each human of this layout, linked ones included, a folder of a state, and point its volumes there.

    A human without its own file keeps the volumes that it has. Raises FileError.
    """
    made: dict[tuple[Path, str], Path] = {}
    for person, shown in earlier_volumes().items():
        folder, own = next(iter(shown.values())).parent, stored_name(person, _PERSON, _PERSON_FILE) or PERSON_FILE
        if (folder, own) not in made:
            made[folder, own] = _converted(person, folder / own, set(shown.values()))
        state = made[folder, own]
        for volume, path in shown.items():
            volume.filepath = str(state / volume_name(int(_VOLUME.fullmatch(path.name)[1])))
        if person.library is None:
            person[HOME] = str(state)
            for name in (_PERSON, _BODY):
                if name in person:
                    del person[name]


def read_earlier_body(path: Path) -> dict[str, NDArray]:
    """The arrays of body_<hash>.npz. Raises ValueError, OSError."""
    return read_numbers(path, tuple(FIELDS), ("pose_basis",), most_values=MOST_BODY_VALUES)


def earlier_volumes() -> dict[bpy.types.Collection, dict[bpy.types.Volume, Path]]:
    """The humans of this layout, and the paths of their volumes."""
    found = {person: _volumes_of(person) for person in bpy.data.collections if MARK in person}
    return {person: volumes for person, volumes in found.items() if volumes}


def _volumes_of(person: bpy.types.Collection) -> dict[bpy.types.Volume, Path]:
    volumes = {obj.data for obj in person.all_objects if obj.type == "VOLUME"}
    paths = {volume: file_path(volume.filepath, volume.library) for volume in volumes}
    return {volume: path for volume, path in paths.items() if path is not None and _VOLUME.fullmatch(path.name)}


def _converted(person: bpy.types.Collection, own: Path, volumes: set[Path]) -> Path:
    """A folder of a state with the human's files: its own, its body's, and the volumes that are written."""
    state = new_state(humans_folder("") / portable_name(bpy.path.clean_name(own.parent.name)))
    copies = {own: PERSON_FILE, **{path: volume_name(int(_VOLUME.fullmatch(path.name)[1])) for path in volumes}}
    try:
        for source, name in copies.items():
            if exists_in_its_folder(source) and not os.path.lexists(state / name):
                copy_file(source, state / name, state, may_link=True)
    except (OSError, FileError) as error:
        remove_state(state)
        raise write_error(state, error) from error
    try:
        body = stored_name(person, _BODY, _BODY_FILE)
        places = (own.parent.parent / body, own.parent / body) if body is not None else ()
        found = next(filter(exists_in_its_folder, places), None)
        if found is not None and exists_in_its_folder(own) and "body" in read_tensors(own).metadata:
            write_body(state / BODY_FILE, read_earlier_body(found))
    except OSError as error:
        remove_state(state)
        raise write_error(state, error) from error
    except ValueError as error:  # a damaged file: the human has no body until the file is replaced
        print(printable(f"PrimDiffusion: {error}"))
    return state
