"""Generate Human. Not redoable: moving a redo slider must not start an expensive job again."""

from __future__ import annotations

import bpy

from ..jobs.follow import submit
from .attributes import asked, parsed
from .settings import SAMPLER_ITEMS
from .work import GenerateWork


class PRIMDIFFUSION_OT_generate(bpy.types.Operator):
    """Generate a person from the seed, and add it to the scene with an armature"""

    bl_idname = "primdiffusion.generate"
    bl_label = "Generate Human"
    bl_options: set[str] = set()  # noqa: RUF012  bpy wants a plain set; neither REGISTER (redo) nor UNDO (the result has one)

    seed: bpy.props.IntProperty(name="Seed", default=-1, min=-1, description="-1: the panel's")
    steps: bpy.props.IntProperty(name="Steps", default=0, min=0, description="0: the panel's")
    sampler: bpy.props.EnumProperty(
        name="Sampler", items=SAMPLER_ITEMS, description="Not given: the panel's", options={"SKIP_SAVE"}
    )
    guidance: bpy.props.FloatProperty(
        name="Guidance", min=0.0, max=20.0, description="Not given: the panel's", options={"SKIP_SAVE"}
    )
    attributes: bpy.props.StringProperty(
        name="Attributes",
        description="Like sex=female, height=1.7; empty: whatever comes. Not given: the panel's",
        options={"SKIP_SAVE"},
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put it in line; in background mode this waits for the person."""
        settings = context.scene.primdiffusion
        given = self.properties.is_property_set
        sampler = self.sampler if given("sampler") else settings.sampler
        guidance = self.guidance if given("guidance") else settings.guidance
        try:
            wanted = parsed(self.attributes) if given("attributes") else asked(settings.attributes)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        asked_of_the_child = {"attributes": wanted, "guidance": guidance} if wanted else {}
        seed, steps = self.seed if self.seed >= 0 else settings.seed, self.steps or settings.steps
        return submit(self, context, GenerateWork(seed, steps, sampler, asked_of_the_child))
