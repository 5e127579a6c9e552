"""Generate Human, and Random Seed."""

from __future__ import annotations

import bpy

from ..jobs.follow import submit
from ..jobs.queue import queue
from .asking import Asking, last_seed
from .settings import random_seed


class PRIMDIFFUSION_OT_generate(Asking, bpy.types.Operator):
    """Generate people from the seed, and add them to the scene with armatures, side by side"""

    bl_idname = "primdiffusion.generate"
    bl_label = "Generate Human"

    count: bpy.props.IntProperty(
        name="Count", default=0, min=0, max=1000, description="How many people; 0: the panel's", options={"SKIP_SAVE"}
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put them in line; in background mode this waits for all."""
        from .work import GenerateWork

        settings = context.scene.primdiffusion
        from_panel = self.seed < 0
        # a script that names the seed means this one person, whatever the panel's number is
        count = self.count or (settings.count if from_panel else 1)
        if from_panel and not settings.keep_seed and settings.seed in _seeds_in_line():
            settings.seed = random_seed()
        seed = settings.seed if from_panel else self.seed
        try:
            last = last_seed(seed, count)
            sampling = self.sampling(settings)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for each in range(seed, last + 1):
            renews = from_panel and not settings.keep_seed and each == last
            if submit(self, context, GenerateWork(each, **sampling, renews_seed=renews)) == {"CANCELLED"}:
                return {"CANCELLED"}
        return {"FINISHED"}


class PRIMDIFFUSION_OT_random_seed(bpy.types.Operator):
    """Put a random seed into the panel"""

    bl_idname = "primdiffusion.random_seed"
    bl_label = "Random Seed"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Also when the seed is locked: the button says so."""
        context.scene.primdiffusion.seed = random_seed()
        return {"FINISHED"}


def _seeds_in_line() -> set[int]:
    """Of people who are asked for already: a second press of the button means somebody else."""
    return {entry.work.seed for entry in queue.in_line if entry.work.kind == "generate"}
