"""Preferences, and the backend's private environment: set up, repaired, removed, tried."""

from __future__ import annotations

import bpy

from . import operators, preferences, session
from .drawing import draw_set_up

__all__ = ["CLASSES", "draw_set_up", "unregister"]

CLASSES = (
    operators.PRIMDIFFUSION_OT_set_up_backend,
    operators.PRIMDIFFUSION_OT_install_from_folder,
    operators.PRIMDIFFUSION_OT_cancel_set_up,
    operators.PRIMDIFFUSION_OT_repair_backend,
    operators.PRIMDIFFUSION_OT_remove_backend,
    operators.PRIMDIFFUSION_OT_test_backend,
    preferences.PRIMDIFFUSION_AP_preferences,
)


def unregister() -> None:
    """End a set-up under way."""
    session.session.cancel()
    if bpy.app.timers.is_registered(session.follow):
        bpy.app.timers.unregister(session.follow)
