"""Blender's windows: what occupies them, redrawing, a window for what a timer runs, and pictures that panels draw."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import bpy.utils.previews
from bpy.app.handlers import persistent

_IN_THE_WAY = {"UNDO", "BLOCKING", "GRAB_CURSOR", "GRAB_CURSOR_X", "GRAB_CURSOR_Y"}
"""Options of modal operators that block the scene or the mouse; others (screencasts) may run for ever."""

_JOBS = {"RENDER": "the render", "OBJECT_BAKE": "the bake"}
"""Blender's jobs that read the scene in a thread of their own, and their names in panels."""
UNDO_REST_S = 0.5
"""Steps of undo and redo follow each other faster than this while a key is held or pressed again and again."""
_last_undo = -math.inf
_looked_at = -math.inf
"""The last undo when `_look_for_more` was called."""
_more_may_wait = False
"""Further steps may wait in Blender's queue."""


def blocking_activity() -> str:
    """What a timer has to wait for before it changes data, as shown in panels; empty for nothing.

    Undo reads only those data-blocks that differ between two of its steps, and keeps the others as they are now. What
    a timer changes between two steps then refers to data that the next step removes, and Blender (5.2.2) crashes. So a
    timer waits until undo and redo have rested, and what it changes becomes an undo step (`apply_result`).

    Files are loaded and saved within one event, during which no timer runs.
    """
    for job, name in _JOBS.items():
        if bpy.app.is_job_running(job):
            return name
    if _more_may_wait or time.monotonic() - _last_undo < UNDO_REST_S:
        return "undo"
    windows = bpy.context.window_manager.windows
    for modal in (modal for window in windows for modal in window.modal_operators):
        if _IN_THE_WAY & modal.bl_options:
            return modal.name
    return ""


@persistent
def note_undo(*_: object) -> None:
    """Handler of undo_post and redo_post: further steps may follow."""
    global _last_undo, _more_may_wait
    _last_undo = time.monotonic()
    if not bpy.app.background:
        _more_may_wait = True
        if not bpy.app.timers.is_registered(_look_for_more):
            bpy.app.timers.register(_look_for_more, first_interval=UNDO_REST_S, persistent=True)


def _look_for_more() -> float | None:
    """The timer: over when no step came between two calls.

    Of the steps that wait, Blender handles one, redraws, which may take longer than UNDO_REST_S, and calls timers.
    """
    global _looked_at, _more_may_wait
    if _looked_at != _last_undo:
        _looked_at = _last_undo
        return UNDO_REST_S
    _more_may_wait = False
    return None


@persistent
def forget_undo(*_: object) -> None:
    """Handler of load_pre: another file has its own steps."""
    global _last_undo, _more_may_wait
    _last_undo, _more_may_wait = -math.inf, False


HANDLERS = (("undo_post", note_undo), ("redo_post", note_undo), ("load_pre", forget_undo))


@contextlib.contextmanager
def window_of(scene: bpy.types.Scene | None) -> Iterator[None]:
    """A context with this scene in a window: timers have none.

    Where no window shows the scene, one switches to it for the block: operators crash in a context whose scene is not
    the window's (5.0).
    """
    windows = list(bpy.context.window_manager.windows)
    window = next((window for window in windows if window.scene == scene), windows[0] if windows else None)
    if window is None:
        yield
        return
    before = window.scene
    if scene is not None and before != scene:
        window.scene = scene
    try:
        with bpy.context.temp_override(window=window):
            yield
    finally:
        if window.scene != before:
            window.scene = before


def redraw() -> None:
    """Redraw sidebars, preferences and status bars of all windows, which do not notice progress themselves.

    Not the views beside them, which take long.
    """
    bpy.msgbus.publish_rna(key=(bpy.types.ViewLayer, "name"))  # status bars, no areas of a screen, subscribe to it
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PREFERENCES":
                area.tag_redraw()
            for region in area.regions if area.type == "VIEW_3D" else ():
                if region.type == "UI":
                    region.tag_redraw()


class Icons:
    """Previews of files, each read when it is first drawn and when it was written again."""

    def __init__(self) -> None:
        self._previews: bpy.utils.previews.ImagePreviewCollection | None = None
        self._versions: dict[str, int] = {}

    def of(self, path: Path | None) -> int:
        """The icon of a file for `template_icon`; 0, which is empty, where there is none."""
        try:
            version = path.stat().st_mtime_ns if path is not None else 0
        except OSError:
            version = 0
        if not version:
            return 0
        if self._previews is None:  # an empty collection is false
            self._previews = bpy.utils.previews.new()
        name = str(path)
        if name not in self._previews or self._versions[name] != version:
            for old in [old for old in self._previews if old == name or not Path(old).exists()]:
                del self._previews[old]
            _ = self._previews.load(name, name, "IMAGE").image_size[:]  # reads the file now: later it may be gone
            self._versions[name] = version
        return self._previews[name].icon_id

    def free(self) -> None:
        """Free all previews."""
        if self._previews is not None:
            bpy.utils.previews.remove(self._previews)
        self._previews, self._versions = None, {}


icons = Icons()
