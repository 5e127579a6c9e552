"""A human in the scene: a marked collection that holds an armature, a body mesh and volumes; and its files."""

from __future__ import annotations

import contextlib
import errno
import filecmp
import hashlib
import itertools
import os
import re
import shutil
from collections import defaultdict
from pathlib import Path
from typing import Any

import bpy

from ..formats.regular_files import (
    FileError,
    check_inside,
    check_regular,
    exists_in_its_folder,
    portable_name,
    real_path,
    remove_folder,
)
from ..formats.whole_files import written_whole
from .blend_values import file_path, stored_folder, stored_record, stored_text

LARGEST_PERSON = 256 << 20
"""Bytes of a human of the backend."""
TEMPORARY = "primdiffusion_humans"
"""Folder, among Blender's temporary files, for the humans of a .blend that was never saved."""
PERSON_FILE = "person.human.safetensors"
"""The human as the backend saves it, in the folder of its state. The volumes beside it are made from it."""
BODY_FILE = "body.safetensors"
"""The body of a human on a body of the user's files, beside PERSON_FILE."""
STATE = re.compile(r"[0-9]{4,9}")
"""Names of folders of states."""
HOME = "primdiffusion_folder"
"""Custom property of a human's collection: the absolute folder of its state when the .blend was last saved. Paths of
volumes are relative to the .blend, which may be moved alone, or opened as a copy in a temporary folder."""
PRIMITIVE_VDB = re.compile(r"prim_([0-9]{4,6})\.vdb")
"""File names of the volumes of primitives."""
MERGED_VDB = re.compile(r"merged_[0-9a-f]{12}(_[0-9]{4,6})?\.vdb")
"""File names of merged volumes; those of a sequence end in the frame, counted from 1."""


class MissingPersonFile(FileNotFoundError):
    """The backend's file of a human is not where it should be."""

    kind = "missing_volumes"
    """The kind of error, by which panels find the remedy."""


def humans_folder(blend_path: str | None = None) -> Path:
    """The folder of a .blend's humans: `<blendname>_humans` beside it, a temporary folder while it is unsaved."""
    blend = Path(blend_path if blend_path is not None else bpy.data.filepath)
    if blend.name:
        return real_path(blend).parent / f"{blend.stem}_humans"
    return Path(bpy.app.tempdir) / TEMPORARY


def stored_path(path: Path) -> str:
    """A path as a .blend should store it: relative (`//`) when the .blend is saved, else absolute."""
    if not bpy.data.filepath:
        return str(path)
    try:
        return bpy.path.relpath(str(path))
    except ValueError:  # another drive on Windows
        return str(path)


def volume_path(volume: bpy.types.Volume) -> Path | None:
    """The absolute path of a human's volume; None where it has no name of such a file, or `file_path` rejects it."""
    path = file_path(volume.filepath, volume.library)
    named = path is not None and (PRIMITIVE_VDB.fullmatch(path.name) or MERGED_VDB.fullmatch(path.name))
    return path if named else None


def sequence_files(volume: bpy.types.Volume) -> list[Path]:
    """All files of a human's volume: those of a merged sequence, else the only one; none without a `volume_path`."""
    path = volume_path(volume)
    if path is None:
        return []
    match = MERGED_VDB.fullmatch(path.name)
    if match is None or match[1] is None:
        return [path]
    return sorted(path.parent.glob(path.name.replace(match[1], "_*")))


def volume_name(k: int) -> str:
    """The file name of a primitive's volume."""
    return f"prim_{k:04d}.vdb"


def folder_of(collection: bpy.types.Collection) -> Path:
    """The folder for a human's states: `<blendname>_humans/<collection name>` (see `humans_folder`)."""
    return humans_folder() / portable_name(bpy.path.clean_name(collection.name))


def state_folder(collection: bpy.types.Collection) -> Path:
    """The folder of a human's state: where its volumes are; of a human without, where it was when it was last saved.

    Holds PERSON_FILE, and the volumes as far as they are written. Volumes keep their paths when a collection is renamed
    and when a .blend is saved elsewhere, and undo switches them back.
    """
    for obj in collection.all_objects:
        path = volume_path(obj.data) if obj.type == "VOLUME" else None
        if path is not None and PRIMITIVE_VDB.fullmatch(path.name):
            return path.parent
    home = stored_folder(collection, HOME)
    if home is None:
        return folder_of(collection) / "0001"
    moved = humans_folder() / home.parent.name / home.name
    return moved if not exists_in_its_folder(home / PERSON_FILE) else home


def state_of(collection: bpy.types.Collection) -> str:
    """Identifies a human's state, wherever its files are: it changes with each edit, and undo switches it back."""
    return hashlib.sha256((stored_text(collection, MARK) or "").encode()).hexdigest()[:12]


def is_own(folder: Path) -> bool:
    """Whether a folder is one of the .blend's own: inside its `humans_folder`, or that of the unsaved one.

    Volumes are written in these alone, wherever a .blend says that they are.
    """
    inner = real_path(folder)
    return any(inner.is_relative_to(real_path(own)) for own in (humans_folder(), humans_folder("")))


def home_of(collection: bpy.types.Collection) -> Path:
    """The folder for new states of a human: the one of its states, if that belongs to this .blend.

    Otherwise (the .blend was saved under another name, the human appended from another .blend) `folder_of`.
    """
    home = state_folder(collection).parent
    return home if is_own(home.parent) else folder_of(collection)


_newest: dict[Path, int] = {}
"""The highest number of a state in each folder of a human that this Blender may have read: it keeps grids by path, also
those of a state whose folder was removed."""


def note_state(folder: Path) -> None:
    """Give the number of this state to no other one while this Blender runs."""
    if STATE.fullmatch(folder.name):
        _newest[folder.parent] = max(was_newest(folder.parent), int(folder.name))


def was_newest(home: Path) -> int:
    """The highest number in `home` that `note_state` has noted; 0 for none."""
    return _newest.get(home, 0)


def new_state(home: Path) -> Path:
    """Make the folder of a human's next state in `home`; numbers count up. Raises FileError."""
    try:
        check_inside(home / "state", home.parent)
        home.mkdir(parents=True, exist_ok=True)
        there = (int(name) for name in os.listdir(home) if STATE.fullmatch(name))
        for number in itertools.count(max((was_newest(home), *there)) + 1):
            with contextlib.suppress(FileExistsError):  # another Blender may have made it just now
                (home / f"{number:04d}").mkdir()
                note_state(home / f"{number:04d}")
                return home / f"{number:04d}"
    except OSError as error:
        raise write_error(home, error) from error
    raise AssertionError("numbers do not end")


def remove_state(folder: Path) -> None:
    """Remove the folder of a state, and the folders around it where they are empty now. Raises no OSError.

    A file that the system has locked stays, and counts as unused.
    """
    remove_folder(folder, folder.parent)
    with contextlib.suppress(OSError):
        folder.parent.rmdir()
        folder.parent.parent.rmdir()


def write_error(folder: Path, error: BaseException) -> FileError:
    """For errors of the system and of openvdb."""
    reason = getattr(error, "strerror", None) or str(error)
    remedy = "save the .blend in a folder with write permission and free space"
    return FileError(folder, f"cannot be written to ({reason:.160})", remedy)


def person_file(collection: bpy.types.Collection) -> Path:
    """The backend's file of a human. Raises MissingPersonFile."""
    path = state_folder(collection) / PERSON_FILE
    if exists_in_its_folder(path):
        return path
    raise MissingPersonFile(
        f"the file of the human {collection.name!r} is missing: {str(path)!r}; put it back, press Find Missing Volumes "
        "in the panel Human, or generate the human again"
    )


def same_file(one: Path, other: Path) -> bool:
    """Whether both exist and have the same content."""
    return exists_in_its_folder(one) and exists_in_its_folder(other) and filecmp.cmp(one, other, shallow=False)


def copy_file(source: Path, destination: Path, folder: Path, *, may_link: bool = False) -> bool:
    """Copy a file of a human to `destination` in `folder`, where it appears whole or not at all; whether it is new.

    Nothing is replaced. With `may_link` the copy is a second name of the same file (a hard link) where the disk has
    those: it takes no space, and deleting or replacing one leaves the other. Files of humans are replaced, never
    written to. Raises FileExistsError where the name is taken by another content, FileError where
    `destination` lies outside of `folder` or `source` is a link out of its own folder, and OSError.
    """
    check_inside(destination, folder)
    check_regular(source)
    if not exists_in_its_folder(source):
        raise FileError(source, "is a link out of its folder and is not copied", "remove it")
    if os.path.lexists(destination):
        if same_file(source, destination):
            return False
        message = "another file of this name is there and is not replaced: move it away"
        raise FileExistsError(errno.EEXIST, message, str(destination))
    destination.parent.mkdir(parents=True, exist_ok=True)
    if may_link and _linked(source, destination):
        return True
    with written_whole(destination) as unfinished:
        shutil.copyfile(source, unfinished)
    return True


def _linked(source: Path, name: Path) -> bool:
    """Give a file a second name, which appears at once, if its disk and the system permit it."""
    if os.path.islink(source):
        return False
    try:
        os.link(source, name)
    except OSError:
        return False
    return True


MARK = "primdiffusion_human"
"""Custom property of a human's collection: provenance as JSON."""
BODY_MARK = "primdiffusion_body"
"""Custom property of a body mesh: the engine leaves it out, shown or hidden."""
BETAS = "primdiffusion_betas"
"""Custom property of a human's armature: the body's shape, which the engine draws and which may be animated."""
ORIGIN = "primdiffusion_origin"
"""Custom property of a human's bones (the armature's data): the origin of the body model in the armature's space [3],
metres, z up. The armature's own origin is on the floor, at the feet. In humans of earlier versions, which lack the
property, the two are one."""
BETA_COUNT = 10
"""Numbers in a shape."""
LARGEST_BETA = 5.0
"""Beyond this, bodies of linear shape models fall apart."""


def provenance_of(collection: bpy.types.Collection) -> dict[str, Any]:
    """How a human was made: seed, steps, attributes, edits and so on; empty where the .blend holds none.

    The fields are the .blend's, of any type; `generated_betas` checks the shape.
    """
    return stored_record(collection, MARK)


def armature_of(collection: bpy.types.Collection) -> bpy.types.Object:
    """The human's armature. Raises ValueError for a collection that is no human or has lost its armature."""
    for obj in collection.objects:
        if MARK in collection and obj.type == "ARMATURE":
            return obj
    raise ValueError(f"the collection {collection.name!r} holds no generated human; select one that does")


def body_of(collection: bpy.types.Collection) -> bpy.types.Object | None:
    """The human's body mesh; None when it was deleted."""
    return next((obj for obj in collection.all_objects if obj.type == "MESH" and BODY_MARK in obj), None)


def volumes_of(collection: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """The human's volume objects by primitive, which the file name gives whatever the object is called now."""
    found = defaultdict(list)
    for obj in collection.all_objects:
        path = volume_path(obj.data) if obj.type == "VOLUME" else None
        if path is not None and (match := PRIMITIVE_VDB.fullmatch(path.name)):
            found[int(match[1])].append(obj)
    return dict(found)


def humans(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """The humans of a scene."""
    return [collection for collection in scene.collection.children_recursive if MARK in collection]


def any_humans() -> bool:
    """Whether this .blend holds humans, in any scene or in none."""
    return any(MARK in collection for collection in bpy.data.collections)


def human_of(obj: bpy.types.Object | None, scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The human that an object is part of, is parented to (a hat on a bone), or instances; None for other objects."""
    while obj is not None:
        around = set(obj.users_collection)
        for collection in humans(scene):
            if not around.isdisjoint([collection, *collection.children_recursive]):
                return collection
        if obj.instance_collection is not None and MARK in obj.instance_collection:
            return obj.instance_collection
        obj = obj.parent
    return None


def own_data(obj: bpy.types.Object, collection: bpy.types.Collection) -> bpy.types.ID:
    """An object's data, copied first where objects of another human use it too (duplicates share data); all objects of
    this human that use it get the copy."""
    if obj.data.users > 1:
        users = [user for user in bpy.data.user_map(subset=[obj.data])[obj.data] if isinstance(user, bpy.types.Object)]
        inside = set(collection.all_objects).intersection(users)
        if len(inside) < len(users):
            copied = obj.data.copy()
            for user in inside:
                user.data = copied
    return obj.data


def check_editable(collection: bpy.types.Collection) -> None:
    """Raises ValueError for a human that is linked from another .blend, or has lost its armature or all volumes."""
    armature = armature_of(collection)
    parts = [collection, armature, armature.data, *(obj.data for obj in collection.all_objects if obj.data)]
    linked = next((part.library for part in parts if part.library is not None), None)
    if linked is not None:
        raise ValueError(
            f"the human {collection.name!r} is linked from {linked.filepath!r}: edit it there, or make it local with "
            "Object > Relations > Make Local > All"
        )
    if not volumes_of(collection):
        raise ValueError(f"the human {collection.name!r} has no volumes left; generate a human again")


def remove_human(collection: bpy.types.Collection) -> None:
    """Remove a human from the .blend: objects, their data, and actions without other users.

    The files stay for undo, and for older copies of the .blend.
    """
    objects = list(collection.all_objects)
    data = [obj.data for obj in objects if obj.data is not None]
    actions = [obj.animation_data.action for obj in objects if obj.animation_data and obj.animation_data.action]
    bpy.data.batch_remove([*objects, *collection.children_recursive, collection])
    bpy.data.batch_remove([block for block in {*data, *actions} if block.users == 0])
