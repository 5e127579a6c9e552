"""A human in the scene: an armature that holds its data, with a body mesh, splats and volumes as its children; which
human the user means, and the human that a job is for, from the click until it is done.

The data are the human's own file, as the backend has saved it, packed in an image. Blender copies, appends, links,
overrides, undoes and saves it with the armature. Readers get it as a file of the session, written once to Blender's
temporary folder, in a folder that is named by the content. The child reads it there, and the volumes for Cycles are
written beside it. An edit packs another image.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import bpy

from ..files.regular_files import FileError, read_regular
from ..files.whole_files import atomic_path
from .blend_values import stored_image, stored_record


def write_error(folder: Path, error: BaseException) -> FileError:
    """For errors of the system and of openvdb."""
    reason = getattr(error, "strerror", None) or str(error)
    remedy = "make room there and allow writing"
    return FileError(folder, f"cannot be written to ({reason:.160})", remedy)


MARK = "primdiffusion_human"
"""Custom property of a human, which is an armature: provenance as JSON."""
BODY_MARK = "primdiffusion_body"
"""Custom property of a body mesh: the engine leaves it out, shown or hidden."""
PROXY_MARK = "primdiffusion_proxy"
"""Custom property of a mesh proxy: the human's file that it was made from and the shape that it shows, as JSON."""
BETAS = "primdiffusion_betas"
"""Custom property of a human: the body's shape, which the engine draws and which may be animated."""
ORIGIN = "primdiffusion_origin"
"""Custom property of a human's bones (the armature's data): the origin of the body model in the armature's space [3],
metres, z up. The armature's own origin is on the floor, at the feet."""
BETA_COUNT = 10
"""Numbers in a shape."""
LARGEST_BETA = 5.0
"""Beyond this, bodies of linear shape models fall apart."""


def is_human(obj: bpy.types.Object) -> bool:
    """Whether an object is a human: an armature with their mark."""
    return obj.type == "ARMATURE" and MARK in obj


def provenance_of(person: bpy.types.Object) -> dict[str, Any]:
    """How a human was made: seed, steps, attributes, edits and so on; empty where the .blend holds none.

    The fields are the .blend's, of any type; `generated_betas` checks the shape.
    """
    return stored_record(person, MARK)


def parts_of(person: bpy.types.Object) -> list[bpy.types.Object]:
    """The human and all objects below it."""
    return [person, *person.children_recursive]


def body_of(person: bpy.types.Object) -> bpy.types.Object | None:
    """The human's body mesh; None when it was deleted."""
    return next((obj for obj in parts_of(person) if obj.type == "MESH" and BODY_MARK in obj), None)


def proxy_of(person: bpy.types.Object) -> bpy.types.Object | None:
    """The human's mesh proxy, if any."""
    return next((obj for obj in parts_of(person) if obj.type == "MESH" and PROXY_MARK in obj), None)


def humans(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The humans of a scene."""
    return [obj for obj in scene.objects if is_human(obj)]


def all_humans() -> list[bpy.types.Object]:
    """The humans of this .blend, in any scene or in none, linked ones included."""
    return [obj for obj in bpy.data.objects if is_human(obj)]


def any_humans() -> bool:
    """Whether this .blend holds humans."""
    return any(map(is_human, bpy.data.objects))


def human_of(obj: bpy.types.Object | None) -> bpy.types.Object | None:
    """The human that an object is part of, is parented to (a hat on a bone), or instances; None for other objects."""
    while obj is not None:
        if is_human(obj):
            return obj
        instanced = obj.instance_collection.all_objects if obj.instance_collection is not None else ()
        if (inside := next(filter(is_human, instanced), None)) is not None:
            return inside
        obj = obj.parent
    return None


def link_part(person: bpy.types.Object, part: bpy.types.Object) -> None:
    """Put a part, which is in no collection, into the one that the human is in."""
    person.users_collection[0].objects.link(part)


def own_data(obj: bpy.types.Object, person: bpy.types.Object) -> bpy.types.ID:
    """An object's data, copied first where objects of another human use it too (duplicates share data); all objects of
    this human that use it get the copy."""
    if obj.data.users > 1:
        users = [user for user in bpy.data.user_map(subset=[obj.data])[obj.data] if isinstance(user, bpy.types.Object)]
        inside = set(parts_of(person)).intersection(users)
        if len(inside) < len(users):
            copied = obj.data.copy()
            for user in inside:
                user.data = copied
    return obj.data


def check_editable(person: bpy.types.Object) -> None:
    """Raises ValueError for a human that is linked from another .blend."""
    blocks = [person, *(obj.data for obj in parts_of(person) if obj.data)]
    linked = next((block.library for block in blocks if block.library is not None), None)
    if linked is not None:
        raise ValueError(
            f"the human {person.name!r} is linked from {linked.filepath!r}: edit it there, or make it local with "
            "Object > Relations > Make Local > All"
        )


@dataclasses.dataclass(frozen=True)
class HumanTarget:
    """A human as it was when the job was queued. Holds no Blender objects, since undo may replace them."""

    uid: int
    """The armature's identity while the file is open (`session_uid`)."""
    name: str
    state: str
    """What the human holds, by `state_of`."""

    @classmethod
    def of(cls, person: bpy.types.Object) -> HumanTarget:
        """Raises ValueError for a human that cannot be edited."""
        check_editable(person)
        return cls(person.session_uid, person.name, state_of(person))

    def found(self) -> bpy.types.Object:
        """The human. Raises ValueError where it is no longer in a scene, or has changed."""
        people = (person for scene in bpy.data.scenes for person in humans(scene))
        person = next((person for person in people if person.session_uid == self.uid), None)
        if person is None:
            raise ValueError(
                f"the human {self.name!r} was removed during the edit; nothing was changed. Undo the "
                "removal and edit again"
            )
        if state_of(person) != self.state:
            raise ValueError(
                f"the human {person.name!r} changed during the edit (by undo or redo); nothing was changed. Edit again"
            )
        check_editable(person)
        return person

    def file_now(self) -> str:
        """Path of the human's own file. Raises as `found` and `session_file` do."""
        return str(session_file(self.found()))


def selected_person(context: bpy.types.Context) -> bpy.types.Object:
    """The human of the active object, else the only human of the scene. Raises ValueError."""
    person = human_of(context.view_layer.objects.active)
    if person is not None:
        return person
    people = humans(context.scene)
    if len(people) == 1:
        return people[0]
    if not people:
        raise ValueError("there is no human in the scene: add one first")
    raise ValueError(f"{len(people)} humans are in the scene: select the one you mean")


def named_person(context: bpy.types.Context, name: str) -> bpy.types.Object:
    """The human of the scene of this name. Raises ValueError, naming those there are."""
    people = humans(context.scene)
    for person in people:
        if person.name == name:
            return person
    if not people:
        raise ValueError(f"the human {name!r} is not in the scene: it has no humans")
    raise ValueError(f"the human {name!r} is not in the scene: choose from {', '.join(repr(p.name) for p in people)}")


PAYLOAD = "primdiffusion"
"""Custom property of a human's armature: the image in which its file is packed."""
BODY = "primdiffusion_body_file"
"""Custom property of the armature of a human on a body of the user's files: the image with the body's file."""
PERSON_FILE = "person.human.safetensors"
"""The name that the backend gives to a human's file."""
BODY_FILE = "body.safetensors"
"""The name of the body's file, beside PERSON_FILE."""
LARGEST_PERSON = 256 << 20
"""Largest file of a human or a body, bytes."""
_FILES = {BODY: BODY_FILE, PAYLOAD: PERSON_FILE}
_digests: dict[tuple[int, int, int], str] = {}
"""Digests of packed files, by the image's identity, size and address."""


def session_folder() -> Path:
    """The folder, among Blender's temporary files, of the files of this session."""
    return Path(bpy.app.tempdir) / "primdiffusion_humans"


def pack(armature: bpy.types.Object, person: Path, *, own_body: bool) -> None:
    """Have an armature hold a human's file, and with `own_body` that of the body beside it; replaces those before.

    Raises ValueError for a file that is too large or not a regular one, OSError.
    """
    files = {PAYLOAD: read_regular(person, LARGEST_PERSON)}
    if own_body:
        files[BODY] = read_regular(person.with_name(BODY_FILE), LARGEST_PERSON)
    for name in _FILES:
        before = stored_image(armature, name, LARGEST_PERSON)
        if name in armature:
            del armature[name]
        if name in files:
            armature[name] = _packed(armature.name, files[name])
        if before is not None and before.users == 0 and before.library is None:
            bpy.data.images.remove(before)


def session_file(armature: bpy.types.Object) -> Path:
    """The human's own file on the disk, with its body's beside it, both from the .blend.

    Raises ValueError for an armature without one, OSError where the temporary folder cannot be written.
    """
    folder = session_folder() / state_of(armature)
    if stored_image(armature, PAYLOAD, LARGEST_PERSON) is None:
        raise ValueError(
            f"{armature.name!r} holds no data of a human: generate the human again, or import its .human file"
        )
    for name, file in _FILES.items():
        image = stored_image(armature, name, LARGEST_PERSON)
        if image is not None and not (folder / file).is_file():
            folder.mkdir(parents=True, exist_ok=True)
            with atomic_path(folder / file) as unfinished:
                unfinished.write_bytes(image.packed_file.data)
    return folder / PERSON_FILE


def state_of(armature: bpy.types.Object) -> str:
    """Identifies what an armature holds, by its content: an edit changes it, undo switches it back."""
    images = (stored_image(armature, name, LARGEST_PERSON) for name in _FILES)
    return "_".join(_digest(image) for image in images if image is not None)


def _packed(name: str, data: bytes) -> bpy.types.Image:
    """An image that holds these bytes: one that is there already, else a new one."""
    digest = _sha256(data)
    for image in bpy.data.images:
        packed = image.packed_file if image.library is None else None
        if packed is not None and packed.size == len(data) and _digest(image) == digest:
            return image
    image = bpy.data.images.new(name, 1, 1)
    image.source = "FILE"
    image.pack(data=data, data_len=len(data))
    return image


def _digest(image: bpy.types.Image) -> str:
    key = (image.session_uid, image.packed_file.size, image.packed_file.as_pointer())
    if key not in _digests:
        _digests[key] = _sha256(image.packed_file.data)
    return _digests[key]


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:24]
