"""The sidebar panel Generate: presets, Generate Human, Random Seed."""

from __future__ import annotations

from pathlib import Path

import bpy
from bl_operators.presets import AddPresetBase
from bl_ui.utils import PresetPanel

from ..jobs.follow import submit
from ..jobs.memory import device_line
from ..jobs.queue import queue
from ..jobs.seeds import last_seed, random_seed
from . import setup
from .attributes import CATEGORIES, SCALARS, draw_attributes
from .drawing import SidebarPanel, draw_job, draw_lines, property_columns
from .generate_settings import Asking
from .manual import draw_manual_button
from .translations import CONTEXT

SUBDIR = "primdiffusion/generate"
_ASKED = (*CATEGORIES, *(part for name in SCALARS for part in (f"use_{name}", name)))

NO_PRESET = "Generate Presets"
"""What the menu says before one is chosen; it shows the name of the one in use, as Blender's own do."""


class PRIMDIFFUSION_PT_generate_presets(PresetPanel, bpy.types.Panel):
    """Choose, add and remove presets"""

    bl_label = NO_PRESET
    preset_subdir = SUBDIR
    preset_operator = "primdiffusion.use_generate_preset"
    preset_add_operator = "primdiffusion.add_generate_preset"


class PRIMDIFFUSION_OT_add_generate_preset(AddPresetBase, bpy.types.Operator):
    """Keep quality, sampler, steps, attributes and guidance as a preset, or remove one"""

    bl_idname = "primdiffusion.add_generate_preset"
    bl_label = "Add Generate Preset"
    preset_menu = "PRIMDIFFUSION_PT_generate_presets"
    preset_subdir = SUBDIR
    preset_defines = ["settings = bpy.context.scene.primdiffusion"]  # noqa: RUF012
    preset_values = [  # noqa: RUF012
        "settings.steps",
        "settings.sampler",
        "settings.guidance",
        *(f"settings.attributes.{name}" for name in _ASKED),
    ]


class PRIMDIFFUSION_OT_use_generate_preset(bpy.types.Operator):
    """Use the settings of this preset"""

    bl_idname = "primdiffusion.use_generate_preset"
    bl_label = "Use Generate Preset"
    bl_options = {"UNDO"}  # noqa: RUF012

    filepath: bpy.props.StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """A checkpoint may not know what a preset asks for; what comes before it is then taken over."""
        path = Path(self.filepath)
        try:
            bpy.utils.execfile(str(path))
        except OSError as error:
            self.report({"ERROR"}, f"The preset cannot be read: {error}. Choose another one")
            return {"CANCELLED"}
        except (TypeError, AttributeError, SyntaxError) as error:
            name = bpy.path.display_name(path.name)
            self.report({"ERROR"}, f"The preset {name!r} does not match this checkpoint or version: {error}. Remove it")
            return {"CANCELLED"}
        PRIMDIFFUSION_PT_generate_presets.bl_label = bpy.path.display_name(path.name)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_generate(Asking, bpy.types.Operator):
    """Generate people from the seed and add them to the scene with armatures, side by side"""

    bl_idname = "primdiffusion.generate"
    bl_label = "Generate Human"

    count: bpy.props.IntProperty(
        name="Count", default=0, min=0, max=1000, description="How many people; 0: the panel's", options={"SKIP_SAVE"}
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put them in line; in background mode this waits for all."""
        from ..jobs.generate import GenerateJob

        settings = context.scene.primdiffusion
        from_panel = self.seed < 0
        # a script that names the seed means this one person, whatever the panel's number is
        count = self.count or (settings.count if from_panel else 1)
        if from_panel and not settings.keep_seed and settings.seed in _queued_seeds():
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
            if submit(self, context, GenerateJob(each, **sampling, renews_seed=renews)) == {"CANCELLED"}:
                return {"CANCELLED"}
        return {"FINISHED"}


class PRIMDIFFUSION_OT_random_seed(bpy.types.Operator):
    """Set a random seed"""

    bl_idname = "primdiffusion.random_seed"
    bl_label = "Random Seed"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Also when the seed is locked: the button says so."""
        context.scene.primdiffusion.seed = random_seed()
        return {"FINISHED"}


def _queued_seeds() -> set[int]:
    """Seeds of humans that are queued: a second press of the button means another human."""
    return {entry.job.seed for entry in queue.queued if entry.job.kind == "generate"}


class PRIMDIFFUSION_PT_generate(SidebarPanel, bpy.types.Panel):
    """Seed, quality, Generate; progress and errors."""

    bl_label = "Generate"
    bl_order = 0

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The menu of presets, and the manual's page."""
        PRIMDIFFUSION_PT_generate_presets.draw_panel_header(self.layout)
        draw_manual_button(self.layout, "first_human")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads what is in line; starts nothing."""
        layout, settings = property_columns(self.layout), context.scene.primdiffusion
        ready = setup.draw_set_up(layout)
        column = layout.column()
        row = column.row(align=True)
        row.prop(settings, "seed")
        row.prop(settings, "keep_seed", text="", icon="LOCKED" if settings.keep_seed else "UNLOCKED")
        row.operator("primdiffusion.random_seed", text="", icon="FILE_REFRESH")
        column.prop(settings, "count")
        column = layout.column()
        column.prop(settings, "quality")
        if settings.quality == "CUSTOM":
            column.prop(settings, "steps")
            column.prop(settings, "sampler")
        draw_job(layout, "generate", "primdiffusion.generate", "OUTLINER_OB_ARMATURE", ready)
        draw_lines(layout, f"Device: {device_line()}", "MEMORY")


class PRIMDIFFUSION_PT_attributes(SidebarPanel, bpy.types.Panel):
    """What the person is asked to be; nothing is asked for unless something is chosen."""

    bl_label = "Attributes"
    bl_translation_context = CONTEXT
    bl_parent_id = "PRIMDIFFUSION_PT_generate"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the checkpoint's card; starts nothing."""
        layout, settings = property_columns(self.layout), context.scene.primdiffusion
        draw_attributes(layout, settings.attributes)
        layout.prop(settings, "guidance")


CLASSES = (
    PRIMDIFFUSION_PT_generate_presets,
    PRIMDIFFUSION_OT_add_generate_preset,
    PRIMDIFFUSION_OT_use_generate_preset,
    PRIMDIFFUSION_OT_generate,
    PRIMDIFFUSION_OT_random_seed,
    PRIMDIFFUSION_PT_generate,
    PRIMDIFFUSION_PT_attributes,
)


def unregister() -> None:
    """The menu of presets shows its own name again."""
    PRIMDIFFUSION_PT_generate_presets.bl_label = NO_PRESET
