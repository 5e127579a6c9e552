"""Blender's dashed lines from children to parents: a thousand volumes have two thousand, which hide the person."""

from __future__ import annotations

import bpy


def hide_relationship_lines() -> None:
    """Turn the overlay off in the 3D viewports of all workspaces; Overlays > Relationship Lines shows them again."""
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type == "VIEW_3D":
                    space.overlay.show_relationship_lines = False
