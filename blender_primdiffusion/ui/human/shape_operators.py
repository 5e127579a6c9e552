"""Reshape, Reset, Random and Copy Shape: quick, so they can be redone with other settings and take one undo step."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import bpy

from ...scene.human import BETA_COUNT
from ..jobs.target import named_person, selected_person
from ..translations import CONTEXT

if TYPE_CHECKING:
    from numpy.typing import NDArray

_HUMAN = "Name of the person (of their collection); empty: the selected one"
_FARTHEST = 3.0


class _Shape:
    """What changes of the shape have in common."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    human: bpy.props.StringProperty(name="Person", description=_HUMAN, options={"SKIP_SAVE", "HIDDEN"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Reports why it cannot be done, and what could not follow."""
        from ...scene.reshape import reshape

        try:
            person = named_person(context, self.human) if self.human else selected_person(context)
            warning = reshape(person, self.betas_for(context, person))
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if warning:
            self.report({"WARNING"}, warning)
        return {"FINISHED"}

    def betas_for(self, context: bpy.types.Context, person: bpy.types.Collection) -> NDArray:
        """The new shape [10]."""
        raise NotImplementedError


class PRIMDIFFUSION_OT_reshape(_Shape, bpy.types.Operator):
    """Give the selected person a shape: numbers, or a height and a weight to reach from there"""

    bl_idname = "primdiffusion.reshape"
    bl_label = "Reshape Human"

    betas: bpy.props.FloatVectorProperty(
        name="Shape", size=BETA_COUNT, description="Standard deviations. Not given: as it is", options={"SKIP_SAVE"}
    )
    height: bpy.props.FloatProperty(name="Height (m)", description="Not given: any", options={"SKIP_SAVE"})
    weight: bpy.props.FloatProperty(name="Weight (kg)", description="Not given: any", options={"SKIP_SAVE"})

    def betas_for(self, _context: bpy.types.Context, person: bpy.types.Collection) -> NDArray:
        """Those given, then moved to the measures."""
        import numpy as np

        from ...scene.shape import betas_of, shape_model_of
        from ...scene.shape_model import betas_of_measures

        given = self.properties.is_property_set
        betas = np.array(self.betas) if given("betas") else betas_of(person)
        height, weight = (getattr(self, name) if given(name) else None for name in ("height", "weight"))
        return betas_of_measures(shape_model_of(person), betas, height, weight)


class PRIMDIFFUSION_OT_reset_shape(_Shape, bpy.types.Operator):
    """Give the selected person the shape they were generated with, or got from their last edit"""

    bl_idname = "primdiffusion.reset_shape"
    bl_label = "Reset Shape"

    def betas_for(self, _context: bpy.types.Context, person: bpy.types.Collection) -> NDArray:
        """From the person's provenance."""
        from ...scene.shape import generated_betas

        return generated_betas(person)


class PRIMDIFFUSION_OT_random_shape(_Shape, bpy.types.Operator):
    """Give the selected person a body at random; the same seed is the same body"""

    bl_idname = "primdiffusion.random_shape"
    bl_label = "Random Shape"

    seed: bpy.props.IntProperty(name="Seed", description="Another seed is another body", min=0)
    spread: bpy.props.FloatProperty(
        name="Spread",
        translation_context=CONTEXT,
        description="How far bodies are from the mean one: 1 as people are",
        default=1.0,
        min=0.0,
        max=2.0,
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Each press of the button is another body."""
        self.seed = random.randrange(2**31)
        return self.execute(context)

    def betas_for(self, _context: bpy.types.Context, _person: bpy.types.Collection) -> NDArray:
        """Normal, kept within what looks like people."""
        import numpy as np

        drawn = np.random.default_rng(self.seed).normal(0.0, self.spread, BETA_COUNT)
        return np.clip(drawn, -_FARTHEST, _FARTHEST)


class PRIMDIFFUSION_OT_copy_shape(_Shape, bpy.types.Operator):
    """Give the selected person the shape of the other person, who stays as they are"""

    bl_idname = "primdiffusion.copy_shape"
    bl_label = "Copy Shape"

    source: bpy.props.StringProperty(
        name="Source", description="Name of the other person. Not given: the panel's", options={"SKIP_SAVE"}
    )

    def betas_for(self, context: bpy.types.Context, person: bpy.types.Collection) -> NDArray:
        """As the engine draws the other person now."""
        from ...scene.shape import betas_of, shape_model_of

        picked = context.scene.primdiffusion_edit.other
        if not self.source and picked is None:
            raise ValueError("choose the other person in the panel first")
        other = named_person(context, self.source or picked.name)
        if other == person:
            raise ValueError(f"{person.name!r} cannot be the other person too: choose somebody else")
        if len(shape_model_of(other).template) != len(shape_model_of(person).template):
            raise ValueError(f"{other.name!r} stands on another body than {person.name!r}: shapes mean something else")
        return betas_of(other)


SHAPES = (
    PRIMDIFFUSION_OT_reshape,
    PRIMDIFFUSION_OT_reset_shape,
    PRIMDIFFUSION_OT_random_shape,
    PRIMDIFFUSION_OT_copy_shape,
)
