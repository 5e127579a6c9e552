"""Disabling when Blender has already taken things away, as 5.2 does at exit."""

from __future__ import annotations

import bpy

import blender_primdiffusion


def test_disabling_after_blender_has_cleared_handlers_and_timers(empty_scene):
    blender_primdiffusion.register()
    kept = {}
    for name in dir(bpy.app.handlers):
        functions = getattr(bpy.app.handlers, name)
        if isinstance(functions, list):
            kept[name] = [one for one in functions if not one.__module__.startswith("blender_primdiffusion")]
            functions.clear()
    try:
        blender_primdiffusion.unregister()
    finally:
        for name, functions in kept.items():
            getattr(bpy.app.handlers, name)[:] = functions
    blender_primdiffusion.register()
    blender_primdiffusion.unregister()
