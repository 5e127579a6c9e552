"""Works of the child: put in line by any room, followed by a timer, shown by progress bars."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from . import follow, operators, queue, result_operator

CLASSES = (operators.PRIMDIFFUSION_OT_cancel, result_operator.PRIMDIFFUSION_OT_take_result)


@persistent
def drop_works_before_loading(*_: object) -> None:
    """Handler of load_pre: what was asked for in one file must not appear in another."""
    queue.queue.close()


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.app.handlers.load_pre.append(drop_works_before_loading)


def unregister() -> None:
    """Undo `register`."""
    queue.queue.close()
    if bpy.app.timers.is_registered(follow.follow):
        bpy.app.timers.unregister(follow.follow)
    bpy.app.handlers.load_pre.remove(drop_works_before_loading)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
