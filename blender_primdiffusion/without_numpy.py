"""What is registered where Blender's Python lacks numpy, as it may in Debian: a panel that says what to install.

Imports nothing that needs numpy. Preferences and the command line say the same.
"""

from __future__ import annotations

import importlib.util
import sys
import textwrap
from collections.abc import Sequence

import bpy

from .console import UNUSABLE

_PACKAGES = {"numpy": "python3-numpy", "openvdb": "python3-openvdb"}
"""Python packages that Blender brings, and their names in Debian and Ubuntu, whose Blenders do not bring them."""
_COMMAND = "primdiffusion"
_SIDEBAR, _PREFERENCES = 34, 90
"""Characters in a line."""
_handles: list[object] = []


def remedy() -> str:
    """Which packages are missing, and how to install them."""
    bpy.utils.expose_bundled_modules()
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    return (
        f"The Python of this Blender lacks {' and '.join(missing)}. Install the packages (on Debian and Ubuntu: "
        f"sudo apt install {' '.join(_PACKAGES[name] for name in missing)}), then start Blender again."
    )


class PRIMDIFFUSION_PT_without_numpy(bpy.types.Panel):
    """In the sidebar, instead of all other panels."""

    bl_label = "PrimDiffusion"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"

    def draw(self, _context: bpy.types.Context) -> None:
        _draw(self.layout, _SIDEBAR)


class PRIMDIFFUSION_AP_preferences(bpy.types.AddonPreferences):
    """Shown in Edit > Preferences > Add-ons, where the user has just enabled the extension."""

    bl_idname = str(__package__)

    def draw(self, _context: bpy.types.Context) -> None:
        _draw(self.layout, _PREFERENCES)


CLASSES = (PRIMDIFFUSION_PT_without_numpy, PRIMDIFFUSION_AP_preferences)


def register() -> None:
    """Register the panel, the preferences and the command line; print what to install."""
    print(f"PrimDiffusion: {remedy()}", file=sys.stderr, flush=True)
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    _handles.append(bpy.utils.register_cli_command(_COMMAND, execute))


def unregister() -> None:
    """Undo `register`."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


def execute(_argv: Sequence[str]) -> int:
    """Refuse a command; returns its exit code."""
    print(f"{_COMMAND}: {remedy()}", file=sys.stderr, flush=True)
    return UNUSABLE


def _draw(layout: bpy.types.UILayout, columns: int) -> None:
    lines = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(remedy(), columns, break_on_hyphens=False)):
        lines.label(text=line, icon="BLANK1" if number else "ERROR", translate=False)
