"""Motion files dropped onto the 3D view."""

from __future__ import annotations

import bpy


class PRIMDIFFUSION_FH_motion(bpy.types.FileHandler):
    """AMASS .npz and .bvh onto the person under the cursor, else the selected one."""

    bl_idname = "PRIMDIFFUSION_FH_motion"
    bl_label = "Motion for a Person"
    bl_import_operator = "primdiffusion.import_motion"
    bl_file_extensions = ".npz;.bvh"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Onto a 3D view; without a person the operator says what is missing."""
        return context.area is not None and context.area.type == "VIEW_3D"
