"""The sidebar panel Generate: settings, Generate Human."""

from __future__ import annotations

import bpy

from ..backend.requests import sentence
from ..jobs.follow import Reporting, submit
from ..jobs.generate import GenerateJob
from ..jobs.queue import queue
from ..scene.human import humans
from .drawing import BackendPanel, draw_job, draw_lines, draw_section, property_columns
from .export_panel import draw_from_file
from .generate_settings import draw_attributes, last_seed, random_seed, sampling, seed_property
from .menus import draw_samples
from .preferences import draw_set_up
from .render_panel import draw_next_step
from .variations_panel import draw_variations


class PRIMDIFFUSION_OT_generate(Reporting, bpy.types.Operator):
    """Generate humans from the seed and add them to the scene with armatures, side by side"""

    bl_idname = "primdiffusion.generate"
    bl_label = "Generate Human"

    seed: seed_property()

    def act(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.primdiffusion
        from_panel = self.seed < 0
        # a seed given by a script means one human, whatever the panel's count
        count = settings.count if from_panel else 1
        if from_panel and not settings.keep_seed and settings.seed in _queued_seeds():
            settings.seed = random_seed()
        seed = settings.seed if from_panel else self.seed
        last = last_seed(seed, count)
        for each in range(seed, last + 1):
            renew_seed = from_panel and not settings.keep_seed and each == last
            next_seed = random_seed() if renew_seed else None
            if submit(self, context, GenerateJob(each, sampling(settings), next_seed=next_seed)) == {"CANCELLED"}:
                return {"CANCELLED"}
        return {"FINISHED"}


def _queued_seeds() -> set[int]:
    """Seeds of queued humans: a second press of the button means another human."""
    return {entry.job.seed for entry in queue.queued if entry.job.kind == "generate"}


class PRIMDIFFUSION_PT_generate(BackendPanel, bpy.types.Panel):
    """Seed, quality, Generate; progress and errors."""

    bl_label = "Generate"
    bl_order = 0
    manual_page = "first_human"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion
        ready = draw_set_up(layout)
        if not ready:
            draw_samples(layout)
        reason = "" if ready else "Set up the backend first."
        column = layout.column()
        row = column.row(align=True)
        row.prop(settings, "seed")
        row.prop(settings, "keep_seed", text="", icon="LOCKED" if settings.keep_seed else "UNLOCKED")
        column.prop(settings, "count")
        column = layout.column()
        column.prop(settings, "quality")
        if settings.quality == "CUSTOM":
            column.prop(settings, "steps")
            column.prop(settings, "sampler")
        draw_job(layout, "generate", "primdiffusion.generate", "OUTLINER_OB_ARMATURE", reason)
        if queue.child_message:
            draw_lines(layout, sentence(f"{queue.child_message}; restarts with the next human"), "ERROR")
        if humans(context.scene) and not queue.busy:
            draw_next_step(layout, context.scene)
        page, section = "first_human", "variations"
        if (body := draw_section(layout, "attributes", text="Attributes", page=page, section="attributes")) is not None:
            draw_attributes(body, settings.attributes)
            body.prop(settings, "guidance")
        if (body := draw_section(layout, "variations", text="Variations", page=page, section=section)) is not None:
            draw_variations(body, context)
        page, section = "export", "human-files"
        if (body := draw_section(layout, "from_file", text="From File", page=page, section=section)) is not None:
            draw_from_file(body)
