"""What operators on one person of the scene have in common."""

from __future__ import annotations

import bpy

from ..jobs.target import named_person, selected_person
from ..scene.human import humans

SKIP = {"SKIP_SAVE"}
PANELS = "Not given: the panel's"


class OnPerson:
    """Finds the person and turns errors into reports; subclasses define `run`."""

    human: bpy.props.StringProperty(
        name="Person", description="Name of the person's collection; empty: the selected person", options=SKIP
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is a person in the scene."""
        cls.poll_message_set("There is no person in the scene: generate one first")
        return bool(humans(context.scene))

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            return self.run(context, self.person(context))
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    def person(self, context: bpy.types.Context) -> bpy.types.Collection:
        """The person named, else the selected one. Raises ValueError."""
        return named_person(context, self.human) if self.human else selected_person(context)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """The operator's own part; ValueError and OSError become reports."""
        raise NotImplementedError
