"""What the user sees and presses: a file a panel, with its settings and operators where they fit.

A module lists what Blender must know: CLASSES, PROPERTIES (owner, name, property), HANDLERS (list of bpy.app.handlers,
function); `register` and `unregister` are for whatever else it needs.
"""

from __future__ import annotations

import bpy

from ..jobs import missing_files
from . import (
    assets_panel,
    attributes,
    batch,
    captures_panel,
    captures_settings,
    edit_operators,
    edit_panel,
    engine_panels,
    export_operators,
    export_panel,
    files_panel,
    generate_panel,
    generate_settings,
    human_panel,
    import_motion,
    jobs_panel,
    manual,
    motion_panel,
    pose_panel,
    reconstruct_panel,
    render_operators,
    render_panel,
    setup,
    shape_panel,
    shape_settings,
    translations,
    variations_operators,
    variations_panel,
)

MODULES = (
    translations, setup, jobs_panel, attributes, generate_settings, generate_panel, variations_operators,
    variations_panel, human_panel, shape_settings, edit_operators, shape_panel, edit_panel, missing_files, files_panel,
    import_motion, motion_panel, pose_panel, assets_panel, engine_panels, render_operators, render_panel,
    captures_settings, captures_panel, reconstruct_panel, export_operators, export_panel, batch, manual,
)  # fmt: skip
"""In the order of registration: later ones refer to settings and parent panels of earlier ones."""


def register() -> None:
    """Register all modules."""
    for module in MODULES:
        for cls in getattr(module, "CLASSES", ()):
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
        for cls in reversed(getattr(module, "CLASSES", ())):
            bpy.utils.unregister_class(cls)
