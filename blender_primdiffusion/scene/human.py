"""A human in the scene: an armature that holds its data, with a body mesh, splats and volumes as its children; which
human the user means, and the human that a job is for, from the click until it is done."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import bpy

from ..files.regular_files import FileError
from .blend_values import stored_record
from .payload import session_file, state_of


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
