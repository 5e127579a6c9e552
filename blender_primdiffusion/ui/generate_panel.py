"""The sidebar panel Generate: settings, presets, Generate Human."""

from __future__ import annotations

import random
from typing import Any

import bpy
from bl_operators.presets import AddPresetBase
from bl_ui.utils import PresetPanel

from ..backend.requests import sentence
from ..formats.requests import SAMPLERS, GenerateRequest
from ..jobs.follow import Reporting, submit
from ..jobs.generate import GenerateJob
from ..jobs.memory import device_line
from ..jobs.queue import queue
from ..scene.human import humans
from .attributes import CATEGORIES, SCALARS, PRIMDIFFUSION_PG_attributes, chosen_attributes, draw_attributes
from .declared import SKIP, declared
from .drawing import BackendPanel, SidebarPanel, draw_job, draw_lines, property_columns
from .export_panel import draw_as_mesh
from .gallery import draw_samples
from .manual import draw_manual_button
from .preferences import draw_set_up
from .render_panel import draw_next_step

LARGEST_SEED = 2**31 - 1
"""The backend itself takes seeds up to 2^63 - 1."""


def random_seed() -> int:
    """A random seed."""
    return random.randrange(LARGEST_SEED + 1)


def last_seed(seed: int, count: int) -> int:
    """The last of `count` consecutive seeds. Raises ValueError beyond LARGEST_SEED."""
    last = seed + count - 1
    if last > LARGEST_SEED:
        raise ValueError(f"{count} seeds from {seed} on go beyond {LARGEST_SEED}: choose a smaller seed")
    return last


STEPS_AND_SAMPLER = {"DRAFT": (8, "dpmpp_2m"), "STANDARD": (30, "ddim"), "HIGH": (60, "ddim")}
CUSTOM = "CUSTOM"
ITEMS = [
    ("DRAFT", "Draft", "8 steps of DPM-Solver++: quick and softer; the same seed sometimes gives another human"),
    ("STANDARD", "Standard", "30 steps of DDIM"),
    ("HIGH", "High", "60 steps of DDIM: twice the time of Standard for a little more detail"),
    (CUSTOM, "Custom", "Steps and sampler as chosen below"),
]


def apply_quality(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """Steps and sampler of the chosen quality. The update function of `quality`."""
    if settings.quality != CUSTOM and quality_of(settings) != settings.quality:
        settings.steps, settings.sampler = STEPS_AND_SAMPLER[settings.quality]


def name_quality(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """The quality with these steps and this sampler. The update function of both."""
    if settings.quality != quality_of(settings):
        settings.quality = quality_of(settings)


def quality_of(settings: bpy.types.PropertyGroup) -> str:
    """The quality with these steps and this sampler, else CUSTOM."""
    chosen = (settings.steps, settings.sampler)
    return next((name for name, both in STEPS_AND_SAMPLER.items() if both == chosen), CUSTOM)


_SAMPLERS = {
    "ddim": ("DDIM", "No noise besides the seed's: the paper's sampler"),
    "dpmpp_2m": ("DPM-Solver++(2M)", "Second-order multistep: good with few steps"),
    "ddpm": ("DDPM", "New noise at each step; needs many steps"),
}
SAMPLER_ITEMS = [(name, *_SAMPLERS[name]) for name in SAMPLERS]


class PRIMDIFFUSION_PG_settings(bpy.types.PropertyGroup):
    """`scene.primdiffusion`."""

    seed: declared(GenerateRequest, "seed", default=10)
    keep_seed: bpy.props.BoolProperty(
        name="Lock Seed", description="Keep the seed; otherwise it is set to a new random one after each human"
    )
    count: bpy.props.IntProperty(
        name="Count",
        description="How many humans: from this seed and the following ones, placed side by side",
        default=1,
        min=1,
        max=1000,
        soft_max=20,
    )
    quality: bpy.props.EnumProperty(
        name="Quality",
        description="Steps and sampler",
        items=ITEMS,
        default="STANDARD",
        update=apply_quality,
    )
    steps: declared(GenerateRequest, "steps", update=name_quality)
    sampler: bpy.props.EnumProperty(
        name="Sampler", description="How the noise is removed", items=SAMPLER_ITEMS, update=name_quality
    )
    guidance: declared(GenerateRequest, "guidance")
    attributes: bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_attributes)


def seed_property():
    """The seed of an operator, for scripts."""
    return declared(GenerateRequest, "seed", default=-1, min=-1, description="-1: the panel's seed", options=SKIP)


def sampling(settings: bpy.types.PropertyGroup) -> dict[str, Any]:
    """Fields of `GenerateRequest` besides the seed."""
    wanted = chosen_attributes(settings.attributes)
    fields = {name: getattr(settings, name) for name in ("steps", "sampler", "guidance")}
    return fields | ({"attributes": wanted} if wanted else {})


SUBDIR = "primdiffusion/generate"
_ASKED = (*CATEGORIES, *(part for name in SCALARS for part in (f"use_{name}", name)))


class PRIMDIFFUSION_PT_generate_presets(PresetPanel, bpy.types.Panel):
    """Choose, add and remove presets"""

    bl_label = "Generate Presets"
    preset_subdir = SUBDIR
    preset_operator = "script.execute_preset"
    preset_add_operator = "primdiffusion.add_generate_preset"


class PRIMDIFFUSION_OT_add_generate_preset(AddPresetBase, bpy.types.Operator):
    """Keep quality, sampler, steps, attributes and guidance as a preset, or remove one"""

    bl_idname = "primdiffusion.add_generate_preset"
    bl_label = "Add Generate Preset"
    preset_menu = "PRIMDIFFUSION_PT_generate_presets"
    preset_subdir = SUBDIR
    preset_defines = ["settings = bpy.context.scene.primdiffusion"]
    preset_values = [
        "settings.steps",
        "settings.sampler",
        "settings.guidance",
        *(f"settings.attributes.{name}" for name in _ASKED),
    ]


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

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        PRIMDIFFUSION_PT_generate_presets.draw_panel_header(self.layout)
        draw_manual_button(self.layout, "first_human")

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion
        ready = draw_set_up(layout)
        if not ready:
            draw_samples(layout)
        reason = "" if ready else "Set up the backend first"
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
            draw_lines(layout, sentence(device_line()), "ERROR")
        if humans(context.scene) and not queue.busy:
            draw_next_step(layout, context.scene)
        if ready:
            draw_as_mesh(layout, context)


class PRIMDIFFUSION_PT_attributes(SidebarPanel, bpy.types.Panel):
    """Attributes to generate with; none unless chosen."""

    bl_label = "Attributes"
    bl_parent_id = "PRIMDIFFUSION_PT_generate"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion
        draw_attributes(layout, settings.attributes)
        layout.prop(settings, "guidance")


PROPERTIES = ((bpy.types.Scene, "primdiffusion", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_settings)),)
