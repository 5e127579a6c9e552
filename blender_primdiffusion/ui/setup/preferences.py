"""Preferences: which Python runs the backend, which checkpoints it uses."""

from __future__ import annotations

import bpy

from ...places import EXTENSION


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
    encoder: bpy.props.StringProperty(
        name="Encoder",
        description="A .safetensors file of the encoder, for people from captures; empty: the one that comes with "
        "the add-on",
        subtype="FILE_PATH",
    )

    def draw(self, _context: bpy.types.Context) -> None:
        """File fields."""
        for name in ("backend_python", "checkpoint", "encoder"):
            self.layout.prop(self, name)
