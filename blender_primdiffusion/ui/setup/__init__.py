"""Preferences: which Python runs the backend, which checkpoints it uses."""

from __future__ import annotations

import bpy

from . import preferences

CLASSES = (preferences.PRIMDIFFUSION_AP_preferences,)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Undo `register`."""
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
