"""What the panel asks for; saved with the scene."""

from __future__ import annotations

import random

import bpy

from ...formats import requests
from .attributes import PRIMDIFFUSION_PG_attributes
from .quality import ITEMS, apply_quality, name_quality

_SAMPLERS = {
    "ddim": ("DDIM", "The noise of the seed alone: as the paper samples"),
    "dpmpp_2m": ("DPM-Solver++(2M)", "Two steps are looked at together: does well with few"),
    "ddpm": ("DDPM", "New noise at each step: wants many"),
}
SAMPLER_ITEMS = [(name, *_SAMPLERS[name]) for name in requests.SAMPLERS]


LARGEST_SEED = 2**31 - 1
"""Blender's properties hold no larger number; scripts of the backend may go to 2^63 - 1."""


def random_seed() -> int:
    """A seed that nobody chose."""
    return random.randrange(LARGEST_SEED + 1)


class PRIMDIFFUSION_PG_settings(bpy.types.PropertyGroup):
    """`scene.primdiffusion`."""

    seed: bpy.props.IntProperty(
        name="Seed", description="Another seed is another person; the same seed is the same person", default=7, min=0
    )
    keep_seed: bpy.props.BoolProperty(
        name="Lock Seed", description="Keep the seed; otherwise each new person leaves a new random one"
    )
    count: bpy.props.IntProperty(
        name="Count",
        description="How many people, of this seed and those that follow on it, one after the other and side by side",
        default=1,
        min=1,
        max=1000,
        soft_max=20,
    )
    quality: bpy.props.EnumProperty(
        name="Quality",
        description="How carefully the noise is taken away",
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
        name="Sampler", description="How the noise is taken away", items=SAMPLER_ITEMS, update=name_quality
    )
    guidance: bpy.props.FloatProperty(
        name="Guidance",
        description="How strongly the attributes are followed: 1 as people are, more exaggerates; "
        "without attributes it does nothing",
        default=requests.GUIDANCE,
        min=0.0,
        max=20.0,
        soft_min=1.0,
        soft_max=5.0,
    )
    attributes: bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_attributes)
