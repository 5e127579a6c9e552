"""When copies of armatures become humans: once the user has let go of them, and at the latest for what needs them.

Undo leads back to the bare copy, and a further step to before it: after undo and redo, nothing is made until something
else is changed.
"""

from __future__ import annotations

import math
import time

import bpy
from bpy.app.handlers import persistent

from ..scene.copies import any_copies, separate_copies
from ..scene.human import any_humans
from .deferred_volumes import keep_writing
from .windows import in_the_way, window_of

SOON_S = 0.2
UNDONE_S = 1.0
"""Changes that come within this time after undo or redo, and after the update that they bring, are their own."""
_undone = -math.inf
_update_follows = False
"""The update that undo or redo bring is still to come: Blender may evaluate the scene for longer than UNDONE_S."""
_held = False
"""Copies are as undo or redo has left them."""


def separate() -> list[str]:
    """Make humans of all copies, as one undo step; returns their names."""
    if not any_humans():
        return []
    names = separate_copies() if any_copies() else []
    if names:
        bpy.ops.ed.undo_push(message="Duplicate Human")
        keep_writing()
    return names


def tick() -> float | None:
    """The timer."""
    if in_the_way() or bpy.context.mode.startswith("EDIT"):
        return SOON_S
    if not _held:
        with window_of(None):
            separate()
    return None


@persistent
def look(*_: object) -> None:
    """Handler of depsgraph_update_post and load_post."""
    global _undone, _update_follows, _held
    if _update_follows:
        _undone, _update_follows = time.monotonic(), False
    elif _held and time.monotonic() - _undone > UNDONE_S:
        _held = False
    if bpy.app.background or _held or not any_humans() or bpy.app.timers.is_registered(tick):
        return
    if any_copies():
        bpy.app.timers.register(tick, first_interval=SOON_S)


@persistent
def hold(*_: object) -> None:
    """Handler of undo_post and redo_post."""
    global _undone, _update_follows, _held
    _undone, _update_follows, _held = time.monotonic(), True, True


@persistent
def separate_before_rendering(*_: object) -> None:
    """Handler of render_init. With a window it runs in the render's thread, where no data may be made."""
    if bpy.app.background:
        separate()


@persistent
def forget(*_: object) -> None:
    """Handler of load_pre: another file has its own steps."""
    global _update_follows, _held
    _update_follows = _held = False


HANDLERS = (
    ("depsgraph_update_post", look),
    ("load_post", look),
    ("load_pre", forget),
    ("undo_post", hold),
    ("redo_post", hold),
    ("render_init", separate_before_rendering),
)


def unregister() -> None:
    """Stop the timer."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
