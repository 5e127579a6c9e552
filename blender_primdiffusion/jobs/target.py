"""The human that a job is for, from the click until it is done; and the human that the user means."""

from __future__ import annotations

import dataclasses

import bpy

from ..scene.human import check_editable, human_of, humans
from ..scene.payload import session_file, state_of


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
