"""Works of the child: put in line by any room, followed by a timer, shown by progress bars."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from . import building, diagnostics, entering, follow, operators, panel, pictures, queue

CLASSES = (
    *operators.CLASSES,
    entering.PRIMDIFFUSION_OT_take_result,
    diagnostics.PRIMDIFFUSION_OT_copy_diagnostics,
    panel.PRIMDIFFUSION_PT_jobs,
)
_TIMERS = (follow.follow, follow.watch)


@persistent
def drop_before_loading(*_: object) -> None:
    """Handler of load_pre: the results of jobs belong into the file that is being closed."""
    queue.queue.drop()
    building.building.close()
    pictures.so_far.show(None)


@persistent
def watch_after_loading(*_: object) -> None:
    """Handler of load_post, and of a load that failed: timers go on."""
    follow.keep_watching()


_HANDLERS = (
    ("load_pre", drop_before_loading),
    ("load_post", watch_after_loading),
    ("load_post_fail", watch_after_loading),
)


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)
    if not bpy.app.background:
        follow.keep_watching()


def unregister() -> None:
    """Undo `register`."""
    queue.queue.close()
    building.building.close()
    pictures.so_far.close()
    for timer in _TIMERS:
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    for name, handler in _HANDLERS:
        if handler in getattr(bpy.app.handlers, name):  # Blender 5.2 clears them before it disables extensions at exit
            getattr(bpy.app.handlers, name).remove(handler)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
