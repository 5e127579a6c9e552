"""Whom an edit is about, from the click until it is done, whatever happens to the scene meanwhile."""

from __future__ import annotations

import dataclasses

import bpy

from ..scene.files import person_file, person_file_name
from ..scene.human import human_of, humans


@dataclasses.dataclass(frozen=True)
class Target:
    """A person as they were when the edit began. Undo may replace Blender's objects, so none is kept."""

    uid: int
    """Of the collection, valid while the file is open."""
    name: str
    file: str
    """Name of the backend's file of the person."""

    @classmethod
    def of(cls, person: bpy.types.Collection) -> Target:
        """Raises ValueError for a person that cannot be edited."""
        from ..scene.human import check_editable

        check_editable(person)
        return cls(person.session_uid, person.name, person_file_name(person))

    def found(self) -> bpy.types.Collection:
        """The person, if still in a scene and the one it was; else ValueError with a sentence."""
        from ..scene.human import check_editable

        people = [person for scene in bpy.data.scenes for person in humans(scene)]
        person = next((person for person in people if person.session_uid == self.uid), None)
        if person is None or not any(thing.type == "ARMATURE" for thing in person.objects):
            raise ValueError(
                f"the person {self.name!r} was removed during the edit; nothing was changed. Undo the "
                "removal and edit again"
            )
        if person_file_name(person) != self.file:
            raise ValueError(
                f"the person {person.name!r} changed during the edit (by undo or redo); nothing was changed. Edit again"
            )
        check_editable(person)
        return person

    def file_now(self) -> str:
        """Path of the backend's file, asked for when it is needed: saving the .blend for the first time moves it.

        Raises as `found` does, and FileNotFoundError.
        """
        return str(person_file(self.found()))


def selected_person(context: bpy.types.Context) -> bpy.types.Collection:
    """Whom the active object belongs to; without such an object the only person of the scene. Raises ValueError."""
    person = human_of(context.view_layer.objects.active, context.scene)
    if person is not None:
        return person
    people = humans(context.scene)
    if len(people) == 1:
        return people[0]
    if not people:
        raise ValueError("there is no person in the scene: generate one first")
    raise ValueError(f"{len(people)} people are in the scene: select the one you mean")


def named_person(context: bpy.types.Context, name: str) -> bpy.types.Collection:
    """The person of the scene whose collection has this name. Raises ValueError, naming who is there."""
    people = humans(context.scene)
    for person in people:
        if person.name == name:
            return person
    if not people:
        raise ValueError(f"the person {name!r} is not in the scene: it has no people")
    raise ValueError(f"the person {name!r} is not in the scene: choose from {', '.join(repr(p.name) for p in people)}")
