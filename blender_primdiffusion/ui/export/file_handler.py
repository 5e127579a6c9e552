"""People dropped onto the 3D view."""

from __future__ import annotations

import bpy


class PRIMDIFFUSION_FH_human(bpy.types.FileHandler):
    """.human files."""

    bl_idname = "PRIMDIFFUSION_FH_human"
    bl_label = "Person"
    bl_import_operator = "primdiffusion.import_human"
    bl_file_extensions = ".human;.safetensors"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Onto a 3D view."""
        return context.area is not None and context.area.type == "VIEW_3D"
