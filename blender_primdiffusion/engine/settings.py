"""The engine's settings in the render tab, saved with the scene."""

from __future__ import annotations

import bpy

from ..formats.requests import RAY_STEP


def _redraw(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """Blender notifies viewports only of changes to its own data."""
    settings.id_data.update_tag()


class PRIMDIFFUSION_PG_render(bpy.types.PropertyGroup):
    """`scene.primdiffusion_render`."""

    step: bpy.props.FloatProperty(
        name="Step",
        description="Distance between samples along a ray: smaller is slower and finer",
        subtype="DISTANCE",
        unit="LENGTH",
        default=RAY_STEP,
        min=0.0005,
        max=0.05,
        soft_min=0.001,
        soft_max=0.016,
        step=0.1,
        precision=4,
        update=_redraw,
    )
    view: bpy.props.EnumProperty(
        name="View",
        description="What is drawn of humans",
        items=(
            ("COLOUR", "Colour", "Humans as they look"),
            ("DEPTH", "Depth", "Near is bright"),
            ("ALPHA", "Alpha", "How opaque the humans are"),
            ("BOXES", "Primitives", "The boxes that humans are made of, shaded, each in a different colour"),
        ),
        default="COLOUR",
        update=_redraw,
    )
    solids: bpy.props.EnumProperty(
        name="Solid Objects",
        description="How meshes and other surfaces are drawn",
        items=(
            ("SHADED", "Shaded", "Drawn with simple shading; they hide humans behind"),
            (
                "HOLDOUT",
                "Holdout",
                "Not drawn, but they cut holes into humans, for compositing over a Cycles render",
            ),
            ("IGNORED", "Ignored", "Humans are drawn as if they were not there"),
        ),
        default="SHADED",
        update=_redraw,
    )
    in_viewports: bpy.props.BoolProperty(
        name="Humans",
        description="Show generated humans in 3D views as the PrimDiffusion engine draws them, wherever their volumes "
        "are hidden",
        default=True,
        update=_redraw,
    )
