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
from ..scene.build import build_missing_parts
from ..scene.human import BODY_MARK, PROXY_MARK, all_humans
from ..scene.merged import MARK as MERGED_MARK
from ..scene.splats import CELLS_MARK, SPLATS_AVAILABLE, SPLATS_MARK, cloud_of
from ..scene.volume_nodes import VOLUMES_MARK, volumes_of
from .windows import blocking_activity, window_of

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
    if blocking_activity() or bpy.context.mode.startswith("EDIT"):
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


_MARKS = (BODY_MARK, PROXY_MARK, VOLUMES_MARK, MERGED_MARK, SPLATS_MARK, CELLS_MARK)
"""Custom properties of parts."""


def orphans() -> list[bpy.types.Object]:
    """Parts of this .blend whose armature was deleted."""
    parts = (obj for obj in bpy.data.objects if any(mark in obj for mark in _MARKS))
    return [part for part in parts if part.parent is None and _is_local(part)]


def without_parts() -> list[bpy.types.Object]:
    """Humans of this .blend that lack splats and volumes: copies of an armature alone."""
    here = (person for person in all_humans() if _is_local(person) and person.users_scene)
    return [one for one in here if volumes_of(one) is None and not (SPLATS_AVAILABLE and cloud_of(one))]


def complete_humans() -> bool:
    """Remove parts without an armature, and give humans without parts their own; whether anything has changed.

    Makes no undo step. Raises as `build_missing_parts`.
    """
    lost, bare = orphans(), without_parts()
    if not (
        lost or bare
    ):  # even of nothing, batch_remove remakes view layers, which crashes a render that begins (5.3)
        return False
    data = {obj.data for obj in lost if obj.data is not None}
    around = {
        collection for obj in lost for collection in obj.users_collection if collection in set(bpy.data.collections)
    }
    bpy.data.batch_remove(lost)
    bpy.data.batch_remove([block for block in data if block.users == 0])
    while empty := [one for one in around if not one.all_objects]:
        around.difference_update(empty)
        bpy.data.batch_remove(empty)
    for person in bare:
        build_missing_parts(person)
    return True


def _is_local(obj: bpy.types.Object) -> bool:
    return obj.library is None and obj.override_library is None
