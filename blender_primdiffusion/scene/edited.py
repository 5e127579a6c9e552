"""A person after an edit, in the place of the person before it.

Only what differs is touched. Every file that an edit writes has a new name, in the folder of the person's others: the
volumes' paths and the name of the person's own file are part of the .blend, so undo and redo go back and forth between
states whose files all stay. `unused` finds those that no state of this .blend as it is now points to.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections import defaultdict
from pathlib import Path

import bpy
import numpy as np

from . import shape_file, volumes
from .armature import move_rest_joints
from .body_mesh import body_of
from .convention import frames_to_blender, points_to_blender
from .human import (
    BETAS,
    MARK,
    PERSON,
    armature_of,
    folder_of,
    people_files,
    person_file,
    provenance,
    volume_path,
)
from .human_file import HumanFile, read_human
from .quaternion import matrix_to_quaternion
from .shape_file import body_files, body_kept

_SAME_BETAS = 1e-5
_PRIMITIVE = re.compile(r"prim_(\d{4,})_[0-9a-f]{12}\.vdb")
_PERSON = re.compile(r"person(_[0-9a-f]{12})?\.human\.safetensors")


@dataclasses.dataclass(frozen=True)
class Replaced:
    """What an edit has changed."""

    volumes: int
    """How many show another file."""
    of: int
    """How many the person has."""
    reshaped: bool
    """The body has another shape: bones, body mesh and places of the volumes have moved."""
    warning: str
    """What could not be done, in a sentence; empty otherwise."""


def check_editable(collection: bpy.types.Collection) -> None:
    """Raises ValueError, with what to do, for a person that lives in another .blend or has lost its armature."""
    armature = armature_of(collection)
    parts = [collection, armature, armature.data, *(thing.data for thing in collection.all_objects if thing.data)]
    linked = next((part.library for part in parts if part.library is not None), None)
    if linked is not None:
        raise ValueError(
            f"the person {collection.name!r} is linked from {linked.filepath!r}: edit it there, or make it local with "
            "Object > Relations > Make Local > All"
        )
    if not _volumes(collection):
        raise ValueError(f"the person {collection.name!r} has no volumes left; generate a person again")


def replace_person(
    context: bpy.types.Context, collection: bpy.types.Collection, human_npz: Path, person: Path
) -> Replaced:
    """Show the person of a human.npz where `collection` shows another, and keep the backend's file `person` of it.

    Armature, pose, animation, transform, names, materials and what else was changed by hand stay. Volumes whose file
    would be another get it; volumes that were deleted stay deleted. Where the betas differ, the bones' rest, the body
    mesh and the volumes' places move too. Raises HumanFileError, VolumeWriteError, ValueError or FileNotFoundError
    before anything in the scene is touched. Takes up to some seconds; makes no undo step, its caller does.
    """
    human = read_human(human_npz)
    check_editable(collection)
    shown = _volumes(collection)
    if max(shown) >= len(human.density):
        raise ValueError(
            f"the person {collection.name!r} has a volume {max(shown)} and the edited one only {len(human.density)}; "
            "use an add-on and a backend of the same release"
        )
    grids = volumes.bake(human.density, human.rgb, human.half_extent)
    home, files = _home(collection), {}
    for k in shown:
        files[k] = home / volumes.file_name(grids, k, bpy.app.version)
    name = f"person_{hashlib.sha256(person.read_bytes()).hexdigest()[:12]}.human.safetensors"
    missing = [k for k, path in files.items() if not path.is_file()]
    with volumes.written(grids, home, {name: person}, missing), body_kept(collection, human.shape_model, home.parent):
        pass
    reshaped = not np.allclose(human.betas, _betas(collection), atol=_SAME_BETAS)
    warning = _reshape(context, collection, human, shown) if reshaped else ""
    changed = 0
    for k, objects in shown.items():
        for thing in objects:
            if volume_path(thing.data) != files[k]:
                _own_data(thing, collection).filepath = volumes.stored_path(files[k])
                changed += 1
    collection[MARK] = provenance(human, grids)
    collection[PERSON] = name
    armature_of(collection).update_tag()
    return Replaced(changed, sum(map(len, shown.values())), reshaped, warning)


def unused(folder: Path) -> list[Path]:
    """Files of people in `folder` that nothing in the .blend, as it is now, points to: of earlier states of people.

    Undo may still want them, and so may other .blend files that share the folder.
    """
    if not folder.is_dir():
        return []
    used = {volume_path(volume).resolve() for volume in bpy.data.volumes if volume.filepath}
    kept = people_files() | body_files()
    found = []
    for path in sorted(folder.rglob("*")):
        of_people = any(pattern.fullmatch(path.name) for pattern in (_PRIMITIVE, _PERSON, shape_file.NAME))
        if of_people and path.name not in kept and path.resolve() not in used:
            found.append(path)
    return found


def _volumes(collection: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """A person's volume objects by primitive, which the name of the file tells whatever the object is called now."""
    found = defaultdict(list)
    for thing in collection.all_objects:
        if thing.type == "VOLUME" and (match := _PRIMITIVE.fullmatch(volume_path(thing.data).name)):
            found[int(match[1])].append(thing)
    return dict(found)


def _home(collection: bpy.types.Collection) -> Path:
    """The folder of the person's files, if it belongs to this .blend.

    Else (saved under another name, appended from another .blend) a folder of its own, into which all of the person
    goes, so that nobody is ever in two places.
    """
    home = person_file(collection).parent
    for own in (volumes.humans_folder(), volumes.humans_folder("")):
        if home.resolve().is_relative_to(own.resolve()):
            return home
    return folder_of(collection)


def _betas(collection: bpy.types.Collection) -> list[float]:
    return json.loads(collection[MARK])["betas"]


def _own_data(thing: bpy.types.Object, collection: bpy.types.Collection):
    """An object's data, copied first where another person's objects show it too (duplicates share data)."""
    if thing.data.users > 1:
        users = bpy.data.user_map(subset=[thing.data])[thing.data]
        if any(isinstance(user, bpy.types.Object) and user not in set(collection.all_objects) for user in users):
            thing.data = thing.data.copy()
    return thing.data


def _reshape(
    context: bpy.types.Context,
    collection: bpy.types.Collection,
    human: HumanFile,
    shown: dict[int, list[bpy.types.Object]],
) -> str:
    """Move bones, body mesh and volumes to the rest places of other betas; returns what could not be moved."""
    armature = armature_of(collection)
    move_rest_joints(context, _own_data(armature, collection), points_to_blender(human.joints))
    armature[BETAS] = human.betas.tolist()
    position, quaternion = points_to_blender(human.position), matrix_to_quaternion(frames_to_blender(human.rotation))
    for k, objects in shown.items():
        for thing in objects:
            thing.location, thing.rotation_quaternion = position[k], quaternion[k]
    body = body_of(collection)
    if body is None:
        return ""
    mesh = _own_data(body, collection)
    if len(mesh.vertices) != len(human.vertices) or mesh.shape_keys is not None:
        return f"the mesh {body.name!r} was changed by hand and keeps its shape"
    mesh.vertices.foreach_set("co", np.asarray(points_to_blender(human.vertices), np.float32).ravel())
    mesh.update()
    return ""
