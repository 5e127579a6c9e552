"""How many variations, of which seeds; saved with the scene."""

from __future__ import annotations

import bpy

from ...formats.requests import AMOUNT

COUNT_ITEMS = [(str(count), str(count), f"{count} people") for count in (4, 8, 12, 16)]


class PRIMDIFFUSION_PG_variations(bpy.types.PropertyGroup):
    """`scene.primdiffusion_variations`."""

    count: bpy.props.EnumProperty(
        name="Count", description="How many people to choose from", items=COUNT_ITEMS, default="8"
    )
    seeds: bpy.props.EnumProperty(
        name="Seeds",
        description="Which people",
        items=[
            ("CONSECUTIVE", "From Seed On", "The seed of the panel Generate and those that follow on it"),
            ("RANDOM", "Random", "Others each time"),
        ],
        default="RANDOM",
    )
    quality: bpy.props.EnumProperty(
        name="Quality",
        description="Whoever is built is exactly the one seen here, in this quality",
        items=[
            ("PANEL", "As Generate", "The steps and sampler of the panel Generate: what is built needs no refining"),
            (
                "DRAFT",
                "Draft",
                "8 steps of DPM-Solver++: quicker and softer. Generating the seed again with more steps refines the "
                "person, and now and then makes another one of it",
            ),
        ],
    )
    amount: bpy.props.FloatProperty(
        name="Difference",
        description="How far More Like This goes from the chosen person: 0 is the person, 1 anybody",
        default=AMOUNT,
        min=0.05,
        max=1.0,
        subtype="FACTOR",
    )
