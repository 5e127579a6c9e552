"""What the panel Generate asks for, saved with the scene, and the same as properties of operators."""

from __future__ import annotations

from typing import Any

import bpy

from ..formats import requests
from ..jobs.seeds import LARGEST_SEED
from .attributes import PRIMDIFFUSION_PG_attributes, asked, parsed

STEPS_AND_SAMPLER = {"DRAFT": (8, "dpmpp_2m"), "STANDARD": (30, "ddim"), "HIGH": (60, "ddim")}
CUSTOM = "CUSTOM"
ITEMS = [
    ("DRAFT", "Draft", "8 steps of DPM-Solver++: quick and softer; the same seed sometimes gives another person"),
    ("STANDARD", "Standard", "30 steps of DDIM"),
    ("HIGH", "High", "60 steps of DDIM: twice the time of Standard for a little more detail"),
    (CUSTOM, "Custom", "Steps and sampler as chosen below"),
]


def apply_quality(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """Steps and sampler of the chosen quality. The update function of `quality`."""
    if settings.quality != CUSTOM and quality_of(settings) != settings.quality:
        settings.steps, settings.sampler = STEPS_AND_SAMPLER[settings.quality]


def name_quality(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """The quality that steps and sampler amount to. The update function of both."""
    if settings.quality != quality_of(settings):
        settings.quality = quality_of(settings)


def quality_of(settings: bpy.types.PropertyGroup) -> str:
    """CUSTOM where no other has these steps and this sampler."""
    chosen = (settings.steps, settings.sampler)
    return next((name for name, both in STEPS_AND_SAMPLER.items() if both == chosen), CUSTOM)


_SAMPLERS = {
    "ddim": ("DDIM", "No noise but that of the seed: the paper's sampler"),
    "dpmpp_2m": ("DPM-Solver++(2M)", "Second-order multistep: good with few steps"),
    "ddpm": ("DDPM", "New noise at each step; needs many steps"),
}
SAMPLER_ITEMS = [(name, *_SAMPLERS[name]) for name in requests.SAMPLERS]


class PRIMDIFFUSION_PG_settings(bpy.types.PropertyGroup):
    """`scene.primdiffusion`."""

    seed: bpy.props.IntProperty(
        name="Seed",
        description="Another seed gives another person; the same seed gives the same person",
        default=7,
        min=0,
    )
    keep_seed: bpy.props.BoolProperty(
        name="Lock Seed", description="Keep the seed; otherwise it is set to a new random one after each person"
    )
    count: bpy.props.IntProperty(
        name="Count",
        description="How many people: from this seed and the following ones, placed side by side",
        default=1,
        min=1,
        max=1000,
        soft_max=20,
    )
    quality: bpy.props.EnumProperty(
        name="Quality",
        description="Steps and sampler of the denoising",
        items=ITEMS,
        default="STANDARD",
        update=apply_quality,
    )
    steps: bpy.props.IntProperty(
        name="Steps",
        description="Denoising steps: more take longer and add detail",
        default=requests.STEPS,
        min=1,
        max=1000,
        soft_max=100,
        update=name_quality,
    )
    sampler: bpy.props.EnumProperty(
        name="Sampler", description="How the noise is removed", items=SAMPLER_ITEMS, update=name_quality
    )
    guidance: bpy.props.FloatProperty(
        name="Guidance",
        description="How strongly the attributes are followed: 1 as in the training data, more exaggerates; "
        "without attributes it does nothing",
        default=requests.GUIDANCE,
        min=0.0,
        max=20.0,
        soft_min=1.0,
        soft_max=5.0,
    )
    attributes: bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_attributes)


_PANELS = "Not given: the panel's"
_SKIP = {"SKIP_SAVE"}


class Asking:
    """Properties of such operators. None is redoable: moving a redo slider must not start an expensive job again."""

    bl_options: set[str] = set()  # noqa: RUF012  bpy wants a plain set; neither REGISTER (redo) nor UNDO (the result has one)

    seed: bpy.props.IntProperty(
        name="Seed", default=-1, min=-1, max=LARGEST_SEED, description="-1: the panel's", options=_SKIP
    )
    steps: bpy.props.IntProperty(name="Steps", default=0, min=0, max=1000, description="0: the panel's", options=_SKIP)
    sampler: bpy.props.EnumProperty(name="Sampler", items=SAMPLER_ITEMS, description=_PANELS, options=_SKIP)
    guidance: bpy.props.FloatProperty(name="Guidance", min=0.0, max=20.0, description=_PANELS, options=_SKIP)
    attributes: bpy.props.StringProperty(
        name="Attributes",
        description="For example sex=female, height=1.7; empty: no restriction. Not given: the panel's",
        options=_SKIP,
    )

    def given(self, name: str) -> bool:
        """Whether a script or a button has said it."""
        return self.properties.is_property_set(name)

    def sampling(self, settings: bpy.types.PropertyGroup) -> dict[str, Any]:
        """Fields steps, sampler and asked of a job. Raises ValueError for attributes that are not name=value."""
        wanted = parsed(self.attributes) if self.given("attributes") else asked(settings.attributes)
        guidance = self.guidance if self.given("guidance") else settings.guidance
        return {
            "steps": self.steps or settings.steps,
            "sampler": self.sampler if self.given("sampler") else settings.sampler,
            "asked": {"attributes": wanted, "guidance": guidance} if wanted else {},
        }


CLASSES = (PRIMDIFFUSION_PG_settings,)
PROPERTIES = ((bpy.types.Scene, "primdiffusion", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_settings)),)
