"""The person in the making: asked for by any room, followed by a timer, shown by progress bars."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from . import follow, operators, session

CLASSES = (operators.PRIMDIFFUSION_OT_cancel,)


@persistent
def drop_job_before_loading(*_: object) -> None:
    """Handler of load_pre: a person asked for in one file must not appear in another."""
    session.session.close()


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.app.handlers.load_pre.append(drop_job_before_loading)


def unregister() -> None:
    """Undo `register`."""
    session.session.close()
    if bpy.app.timers.is_registered(follow.follow):
        bpy.app.timers.unregister(follow.follow)
    bpy.app.handlers.load_pre.remove(drop_job_before_loading)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
