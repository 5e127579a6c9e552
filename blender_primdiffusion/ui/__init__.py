"""What the user sees and presses: a file a panel, with its settings and operators where they fit.

A module's classes named PRIMDIFFUSION_* are registered in the order in which they are defined, then SUB_PANELS, its
PROPERTIES (owner, name, property) and HANDLERS (list of bpy.app.handlers, function). `register` and `unregister` do
the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType

import bpy

from ..jobs import follow, parts, volumes, windows
from . import (
    advanced_panel,
    captures_panel,
    edit_panel,
    export_panel,
    generate_panel,
    generate_settings,
    human_panel,
    jobs_panel,
    menus,
    motion_panel,
    picture_panel,
    preferences,
    render_panel,
    shape_panel,
    variations_panel,
)

MODULES = (
    *filter(None, (preferences.setup, preferences)), windows, follow, jobs_panel,
    generate_settings, variations_panel, generate_panel, human_panel, shape_panel, edit_panel, parts,
    volumes, motion_panel, picture_panel,
    render_panel, export_panel, advanced_panel,
    captures_panel, menus,
)  # fmt: skip
"""In the order of registration: later ones refer to settings and parent panels of earlier ones."""


def register() -> None:
    """Register all modules."""
    for module in MODULES:
        for cls in classes_of(module):
            bpy.utils.register_class(cls)
        for owner, name, prop in getattr(module, "PROPERTIES", ()):
            setattr(owner, name, prop)
        for name, handler in getattr(module, "HANDLERS", ()):
            getattr(bpy.app.handlers, name).append(handler)
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    """Undo `register`; child processes end."""
    for module in reversed(MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
        for name, handler in getattr(module, "HANDLERS", ()):
            if handler in getattr(bpy.app.handlers, name):  # 5.2 clears them before it disables extensions at exit
                getattr(bpy.app.handlers, name).remove(handler)
        for owner, name, _ in getattr(module, "PROPERTIES", ()):
            delattr(owner, name)
        for cls in reversed(list(classes_of(module))):
            bpy.utils.unregister_class(cls)


def classes_of(module: ModuleType) -> Iterator[type]:
    """The classes of a module that Blender registers, in order."""
    for name, value in vars(module).items():
        if name.startswith("PRIMDIFFUSION_") and value.__module__ == module.__name__:
            yield value
    yield from getattr(module, "SUB_PANELS", ())
