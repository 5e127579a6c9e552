"""Preferences: which Python runs the generator, which checkpoint it uses."""

from __future__ import annotations

import bpy

from ..places import EXTENSION


class PRIMDIFFUSION_AP_preferences(bpy.types.AddonPreferences):
    """Shown in Edit > Preferences > Add-ons > PrimDiffusion."""

    bl_idname = EXTENSION

    backend_python: bpy.props.StringProperty(
        name="Backend Python",
        description="Python 3.11 or newer with PrimDiffusion's packages (torch); empty: found by itself",
        subtype="FILE_PATH",
    )
    checkpoint: bpy.props.StringProperty(
        name="Checkpoint",
        description="A .safetensors file of the diffusion model; empty: the one that comes with the add-on",
        subtype="FILE_PATH",
    )

    def draw(self, _context: bpy.types.Context) -> None:
        """Two file fields."""
        self.layout.prop(self, "backend_python")
        self.layout.prop(self, "checkpoint")
