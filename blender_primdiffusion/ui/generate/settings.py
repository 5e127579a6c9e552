"""What the panel asks for; saved with the scene."""

from __future__ import annotations

import bpy

from ...worker.names import SAMPLERS
from .attributes import PRIMDIFFUSION_PG_attributes

_SAMPLERS = {
    "ddim": ("DDIM", "The noise of the seed alone: as the paper samples"),
    "dpmpp_2m": ("DPM-Solver++(2M)", "Two steps are looked at together: does well with few"),
    "ddpm": ("DDPM", "New noise at each step: wants many"),
}
SAMPLER_ITEMS = [(name, *_SAMPLERS[name]) for name in SAMPLERS]


class PRIMDIFFUSION_PG_settings(bpy.types.PropertyGroup):
    """`scene.primdiffusion`."""

    seed: bpy.props.IntProperty(
        name="Seed", description="Another seed is another person; the same seed is the same person", default=7, min=0
    )
    steps: bpy.props.IntProperty(
        name="Steps",
        description="Denoising steps: more take longer and add detail",
        default=30,
        min=1,
        max=1000,
        soft_max=100,
    )
    sampler: bpy.props.EnumProperty(name="Sampler", description="How the noise is taken away", items=SAMPLER_ITEMS)
    guidance: bpy.props.FloatProperty(
        name="Guidance",
        description="How strongly the attributes are followed: 1 as people are, more exaggerates; "
        "without attributes it does nothing",
        default=1.5,
        min=0.0,
        max=20.0,
        soft_min=1.0,
        soft_max=5.0,
    )
    attributes: bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_attributes)
