"""A human in the scene: a marked collection that holds an armature, a body mesh and volumes; and its files."""

from __future__ import annotations

import errno
import filecmp
import hashlib
import os
import re
import shutil
from collections import defaultdict
from pathlib import Path
from typing import Any

import bpy

from ..formats.regular_files import check_regular, exists_in_its_folder, portable_name, read_regular, real_path
from ..formats.removing import OutsideFolderError, check_inside
from ..formats.whole_files import written_whole
from .blend_values import file_path, stored_name, stored_record

LARGEST_PERSON = 256 << 20
"""Bytes of a human of the backend."""
TEMPORARY = "primdiffusion_humans"
"""Folder, among Blender's temporary files, for the humans of a .blend that was never saved."""
PERSON_FILE = "person.human.safetensors"
"""The human as the backend saves it, beside the volumes."""
NPZ_FILE = "human.npz"
"""The human for Blender, beside PERSON_FILE."""
PERSON = "primdiffusion_person_file"
"""Custom property of a human's collection: the name of the backend's file since the last edit. Undo switches it back,
as it does the paths of the volumes."""
HOME = "primdiffusion_folder"
"""Custom property of a human's collection: the absolute folder of its files when the .blend was last saved. Paths of
volumes are relative to the .blend, which may be moved alone, or opened as a copy in a temporary folder."""
PERSON_FILES = re.compile(r"person(_[0-9a-f]{12})?\.human\.safetensors")
"""Names that PERSON may hold; the hash is of the content."""
PRIMITIVE_VDB = re.compile(r"prim_([0-9]{4,6})_[0-9a-f]{12}\.vdb")
"""File names of the volumes of primitives; the hash is of the content."""
MERGED_VDB = re.compile(r"merged_[0-9a-f]{12}(_[0-9]{4,6})?\.vdb")
"""File names of merged volumes; those of a sequence end in the frame, counted from 1."""


UNWRITTEN_NPZ = re.compile(r"unwritten_[0-9a-f]{12}\.npz")
"""File names of humans whose volumes are written later (see `unwritten`); the hash is of the volumes' names."""


class VolumeWriteError(OSError):
    """Files of a human could not be written; nothing was left behind."""


def link_error(folder: Path) -> VolumeWriteError:
    """For a folder of a human that leads out of the folder that it is in."""
    return VolumeWriteError(f"{str(folder)!r} is a link to another folder: nothing is written there, remove the link")


class MissingPersonFile(FileNotFoundError):
    """The backend's file of a human is not where it should be."""

    kind = "missing_volumes"
    """By which panels find the remedy."""


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


def unwritten_in(folder: Path) -> list[Path]:
    """Files in a folder from which volumes are still to be written there; none where the folder cannot be read."""
    try:
        found = sorted(folder / name for name in os.listdir(folder) if UNWRITTEN_NPZ.fullmatch(name))
    except OSError:
        return []
    return [path for path in found if exists_in_its_folder(path)]


def folder_of(collection: bpy.types.Collection) -> Path:
    """The folder for a human's files: `<blendname>_humans/<collection name>` (see `humans_folder`)."""
    return humans_folder() / portable_name(bpy.path.clean_name(collection.name))


def folders_of(collection: bpy.types.Collection) -> list[Path]:
    """Where a human's files may be: beside the volumes wherever these are, else `folder_of`.

    Volumes keep their paths when a collection is renamed and when a .blend is saved elsewhere. A merged volume may be
    in another folder than those of the primitives, which have the files beside them.
    """
    merged: list[Path] = []
    for obj in collection.all_objects:
        if obj.type == "VOLUME" and (path := volume_path(obj.data)) is not None:
            if PRIMITIVE_VDB.fullmatch(path.name):
                return [path.parent, folder_of(collection)]
            merged.append(path.parent)
    return [*merged[:1], folder_of(collection)]


def is_own(folder: Path, blend_path: str | None = None) -> bool:
    """Whether a folder is one of a .blend's own: inside its `humans_folder`, or that of the unsaved one.

    Volumes are written in these alone, wherever a .blend says that they are.
    """
    inner = real_path(folder)
    return any(inner.is_relative_to(real_path(own)) for own in (humans_folder(blend_path), humans_folder("")))


def home_of(collection: bpy.types.Collection) -> Path:
    """The folder for new files of a human: the one of its files, if that belongs to this .blend.

    Otherwise (the .blend was saved under another name, the human appended from another .blend) `folder_of`, which then
    gets all files, so that they are never in two places.
    """
    folders = folders_of(collection)
    name = person_file_name(collection)
    home = next((folder for folder in folders if exists_in_its_folder(folder / name)), folders[0])
    return home if is_own(real_path(home).parent) else folder_of(collection)  # bodies are in the parent


def person_file_name(collection: bpy.types.Collection) -> str:
    """The name of `person_file`, which each edit changes."""
    return stored_name(collection, PERSON, PERSON_FILES) or PERSON_FILE


def person_file(collection: bpy.types.Collection) -> Path:
    """The backend's file of a human. Raises MissingPersonFile."""
    name, folders = person_file_name(collection), folders_of(collection)
    for folder in folders:
        if exists_in_its_folder(folder / name):
            return folder / name
    raise MissingPersonFile(
        f"the file of the human {collection.name!r} is missing: {str(folders[0] / name)!r}; put it back beside "
        "the human's volumes, press Find Missing Volumes in the panel Human, or generate the human again"
    )


def content_name(person: Path) -> str:
    """A name for the backend's file of a human that no other content has."""
    return f"person_{hashlib.sha256(read_regular(person, LARGEST_PERSON)).hexdigest()[:12]}.human.safetensors"


def available_name(person: Path, folder: Path, name: str) -> str:
    """The name for a copy of the backend's file in `folder`: `name`, unless another human's file has it, which undo
    may need."""
    taken = folder / name
    if not os.path.lexists(taken) or _same_file(person, taken):
        return name
    return content_name(person)


def _same_file(one: Path, other: Path) -> bool:
    return exists_in_its_folder(other) and filecmp.cmp(one, other, shallow=False)


def is_there(source: Path, destination: Path) -> bool:
    """Whether `destination` is a copy of `source` already. Raises FileExistsError where it is another file."""
    if not os.path.lexists(destination):
        return False
    if not _same_file(source, destination):
        message = "another file of this name is there and is not replaced: move it away"
        raise FileExistsError(errno.EEXIST, message, str(destination))
    return True


def copy_file(source: Path, destination: Path, folder: Path, *, may_link: bool = False) -> bool:
    """Copy a file of a human to `destination` in `folder`, where it appears whole or not at all; whether it is new.

    Nothing is replaced. With `may_link` the copy is a second name of the same file (a hard link) where the disk has
    those: it takes no space, and deleting or replacing one leaves the other. Files of humans are replaced, never
    written to. Raises FileExistsError where the name is taken by another content, OutsideFolderError where
    `destination` lies outside of `folder` or `source` is a link out of its own folder, and OSError.
    """
    check_inside(destination, folder)
    check_regular(source)
    if not exists_in_its_folder(source):
        raise OutsideFolderError(f"{source} is a link out of its folder and is not copied: remove it")
    if is_there(source, destination):
        return False
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

    The VDB files stay for undo, and for older copies of the .blend.
    """
    objects = list(collection.all_objects)
    data = [obj.data for obj in objects if obj.data is not None]
    actions = [obj.animation_data.action for obj in objects if obj.animation_data and obj.animation_data.action]
    bpy.data.batch_remove([*objects, *collection.children_recursive, collection])
    bpy.data.batch_remove([block for block in {*data, *actions} if block.users == 0])
