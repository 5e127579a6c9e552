"""Files of people that are missing, found or made again; and all of them brought beside the .blend."""

from __future__ import annotations

import bpy

from . import operators, saving, watching

_HANDLERS = (
    ("save_pre", saving.collect_before_saving),
    ("load_post", watching.look_after),
    ("save_post", watching.look_after),
    ("undo_post", watching.look_soon),
    ("redo_post", watching.look_soon),
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in operators.CLASSES:
        bpy.utils.register_class(cls)
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)
    watching.start()


def unregister() -> None:
    """Undo `register`."""
    watching.stop()
    for name, handler in _HANDLERS:
        if handler in getattr(bpy.app.handlers, name):  # Blender 5.2 clears them before it disables extensions at exit
            getattr(bpy.app.handlers, name).remove(handler)
    for cls in reversed(operators.CLASSES):
        bpy.utils.unregister_class(cls)
