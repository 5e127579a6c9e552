"""What the panel asks for; saved with the scene."""

from __future__ import annotations

import bpy


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
