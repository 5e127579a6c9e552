"""When the parts of humans follow what Blender's own operators did to armatures: once the user has let go, and at the
latest for what needs them.

Undo leads back to the bare copy, or to the parts alone, and a further step to before it: after undo and redo, nothing
changes until the number of objects does.
"""

from __future__ import annotations

import math
import time

import bpy
from bpy.app.handlers import persistent

from ..files.regular_files import printable
from ..scene.parts import complete_humans, orphans, without_parts
from .windows import in_the_way, window_of

SOON_S = 0.2
UNDONE_S = 1.0
"""Changes that come within this time after undo or redo, and after the update that they bring, are their own."""
_undone = -math.inf
_update_follows = False
"""The update that undo or redo bring is still to come: Blender may evaluate the scene for longer than UNDONE_S."""
_held = False
"""Humans are as undo or redo has left them."""
_counted = 0
"""Objects of the file when they were last looked through: Blender's operators that matter change their number."""


def complete() -> None:
    """Complete all humans, as one undo step."""
    try:
        changed = complete_humans()
    except (OSError, ValueError) as error:
        print(printable(f"PrimDiffusion: {error}"))
        return
    if changed:
        bpy.ops.ed.undo_push(message="Parts of Humans")


def tick() -> float | None:
    """The timer."""
    if in_the_way() or bpy.context.mode.startswith("EDIT"):
        return SOON_S
    if not _held:
        with window_of(None):
            complete()
    return None


@persistent
def look(*_: object) -> None:
    """Handler of depsgraph_update_post and load_post."""
    global _undone, _update_follows, _held, _counted
    if _update_follows:
        _undone, _update_follows = time.monotonic(), False
    elif _held and time.monotonic() - _undone > UNDONE_S:
        _held = False
    if bpy.app.background or _held or len(bpy.data.objects) == _counted or bpy.app.timers.is_registered(tick):
        return
    _counted = len(bpy.data.objects)
    if orphans() or without_parts():
        bpy.app.timers.register(tick, first_interval=SOON_S)


@persistent
def hold(*_: object) -> None:
    """Handler of undo_post and redo_post."""
    global _undone, _update_follows, _held, _counted
    _undone, _update_follows, _held, _counted = time.monotonic(), True, True, len(bpy.data.objects)


@persistent
def complete_before_rendering(*_: object) -> None:
    """Handler of render_init. With a window it runs in the render's thread, where no data may be made."""
    if bpy.app.background:
        complete()


@persistent
def forget(*_: object) -> None:
    """Handler of load_pre: another file has its own steps."""
    global _update_follows, _held, _counted
    _update_follows, _held, _counted = False, False, 0


HANDLERS = (
    ("depsgraph_update_post", look),
    ("load_post", look),
    ("load_pre", forget),
    ("undo_post", hold),
    ("redo_post", hold),
    ("render_init", complete_before_rendering),
)


def unregister() -> None:
    """Stop the timer."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
