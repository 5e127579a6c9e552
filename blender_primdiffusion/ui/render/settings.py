"""What the Render panel asks for: of the scene, and of each person's material."""

from __future__ import annotations

import bpy

from ...formats.requests import DENSITY_GAIN, VOXEL
from ...scene.material import density_gain, set_density_gain


class PRIMDIFFUSION_PG_merging(bpy.types.PropertyGroup):
    """`scene.primdiffusion_merging`."""

    voxel: bpy.props.FloatProperty(
        name="Voxel Size",
        description="Side of the merged volume's voxels: half the size shows more and takes eight times the memory",
        subtype="DISTANCE",
        unit="LENGTH",
        default=VOXEL,
        min=0.001,
        max=0.1,
        soft_min=0.003,
        soft_max=0.02,
        step=0.1,
        precision=4,
    )


def _gain(person: bpy.types.Collection) -> float:
    gain = density_gain(person)
    return DENSITY_GAIN if gain is None else gain


def _set_gain(person: bpy.types.Collection, gain: float) -> None:
    try:
        set_density_gain(person, gain)
    except ValueError as error:  # nobody listens to a property
        print(f"PrimDiffusion: {error}")


def gain_property() -> bpy.props.FloatProperty:
    """`collection.primdiffusion_density_gain` of a person's collection."""
    return bpy.props.FloatProperty(
        name="Density Gain",
        description="How much denser Cycles takes this person for: it absorbs exponentially, the exact engine adds up",
        min=0.01,
        max=100.0,
        soft_min=0.5,
        soft_max=5.0,
        step=10,
        get=_gain,
        set=_set_gain,
    )
