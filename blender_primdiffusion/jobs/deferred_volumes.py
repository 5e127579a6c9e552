"""Volumes written after their humans stand: by a timer while the user works, or at the latest for a render."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..backend.requests import sentence
from ..engine.engine import ENGINE
from ..engine.gpu.overlay import overlay
from ..formats.regular_files import FileError, printable
from ..places import EXTENSION
from ..scene.collect import collect_pending
from ..scene.earlier_files import convert_earlier
from ..scene.human import any_humans
from ..scene.pending import (
    PendingVolumes,
    is_wanted,
    newer_text,
    pending_volumes,
    show_written,
    write_all_pending,
    write_pending,
)
from .windows import in_the_way, redraw

ALWAYS, WHEN_RENDERING = "ALWAYS", "WHEN_RENDERING"
"""Values of the preference `volumes`."""
PAUSE_S = 0.02
"""Between two slices, at least."""
SHORTEST_S, LONGEST_S = 0.05, 0.1
"""Of a slice. In between, it is as long as the pause before it, in which Blender may have drawn."""
BLOCKED_S = 0.25
FIRST_S = 1.0
"""After a human has entered, until writing begins: views draw the human first."""


class DeferredVolumes:
    """Writes the volumes of one human after the other, in slices. All methods but `finish` are for the main thread."""

    def __init__(self) -> None:
        self.error = ""
        """Why volumes could not be written; empty when they could."""
        self.notice = ""
        """Which volumes are written again, and why; empty when none are."""
        self._left: list[PendingVolumes] = []
        """The humans whose volumes are left to write; looked up when it is empty."""
        self._steps: Generator[None, None, None] | None = None
        self._failed: set[Path] = set()
        """Folders whose volumes could not be written."""
        self._ended = 0.0

    def work(self, seconds: float) -> bool:
        """Write for about `seconds`, one step at least; whether more is left."""
        if self._left and not is_wanted(self._left[0]):  # the human was removed, or is in another state
            self.stop()
        if not self._left:
            self.bring_here()
            self._left = [one for one in pending_volumes() if one.folder not in self._failed]
        if not self._left:
            return False
        pending = self._left[0]
        self._steps = write_pending(pending) if self._steps is None else self._steps
        end = time.monotonic() + seconds
        try:
            next(self._steps)
            while time.monotonic() < end:
                next(self._steps)
        except StopIteration:
            self._steps = None
            self._left = self._left[1:]
            self.notice = self.notice if any(one.newer for one in self._left) else ""
            show_written()
        except (OSError, ValueError) as error:
            self.stop()
            self._failed.add(pending.folder)
            self._report(error)
            redraw()
        return True

    def bring_here(self) -> None:
        """Have humans elsewhere, whose volumes are still to be written, in this .blend's own folders (see
        `collect_pending`)."""
        self._try(collect_pending)

    def convert(self) -> None:
        """Have humans of the earlier layout in folders of states."""
        self._try(convert_earlier)

    def _try(self, change: Callable[[], object]) -> None:
        try:
            change()
        except (OSError, FileError) as error:
            if self.error != str(error):
                print(printable(f"PrimDiffusion: {error}"))
            self.error = str(error)

    def finish(self) -> None:
        """Write all that is left, with steps of its own: renders call it from another thread."""
        self.forget_failures()
        if bpy.app.background:  # in the main thread
            self.bring_here()
        try:
            write_all_pending()
        except (OSError, ValueError) as error:
            self._report(error)
        if bpy.app.background:
            show_written()

    def look_for_newer(self) -> None:
        """Find volumes that only a newer Blender can read, say so once, and write at once those that viewports read."""
        newer = [one for one in pending_volumes() if one.newer]
        if not newer:
            self.notice = ""
            return
        notice = sentence(newer_text(newer))
        if self.notice != notice:
            self.notice = notice
            print(printable(f"PrimDiffusion: {notice}"))
        try:
            for one in newer:
                if one.in_views:
                    for _ in write_pending(one):
                        pass
        except (OSError, ValueError) as error:
            self._report(error)

    def forget_failures(self) -> None:
        """Try again what could not be written, and say again what is written again."""
        self._failed.clear()
        self.error = self.notice = ""

    def tick(self) -> float | None:
        """The timer: a slice of writing, until all is written. Views that humans are drawn in come first."""
        if in_the_way() or not overlay.resting:
            return BLOCKED_S
        drawing = time.monotonic() - self._ended - PAUSE_S
        more = self.work(min(max(drawing, SHORTEST_S), LONGEST_S))
        self._ended = time.monotonic()
        return PAUSE_S if more else None

    def stop(self) -> None:
        """Stop writing; what is written stays, and the rest is looked up again."""
        if self._steps is not None:
            self._steps.close()
        self._left, self._steps = [], None

    def _report(self, error: Exception) -> None:
        self.error, self.notice = str(error), ""
        print(printable(f"PrimDiffusion: {error}"))


deferred_volumes = DeferredVolumes()
"""One for all humans."""


def preferred() -> str:
    """When volumes are written: the preference, or ALWAYS."""
    addon = bpy.context.preferences.addons.get(EXTENSION)
    return getattr(addon.preferences, "volumes", ALWAYS) if addon is not None else ALWAYS


def keep_writing() -> None:
    """Have Blender write what is not written yet, unless the preference is to wait for a render."""
    deferred_volumes.stop()  # other volumes may be wanted now
    if bpy.app.background or preferred() != ALWAYS or not any_humans():
        return
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=FIRST_S, persistent=True)


def _bring_here() -> None:
    if any_humans():
        deferred_volumes.bring_here()


def _bring_here_soon() -> float | None:
    """The timer: paths of volumes change, which must not happen while steps of undo wait."""
    if in_the_way():
        return BLOCKED_S
    _bring_here()
    return None


def _tick() -> float | None:
    return deferred_volumes.tick()


@persistent
def write_soon(*_: object) -> None:
    """Handler of save_post, undo_post and redo_post, after which other files may be wanted."""
    if bpy.app.background:
        _bring_here()
    elif not bpy.app.timers.is_registered(_bring_here_soon):
        bpy.app.timers.register(_bring_here_soon, persistent=True)
    keep_writing()


@persistent
def write_after_loading(*_: object) -> None:
    """Handler of load_post."""
    deferred_volumes.forget_failures()
    write_after_importing()


@persistent
def write_after_importing(*_: object) -> None:
    """Handler of blend_import_post: humans were appended or linked."""
    if any_humans():
        deferred_volumes.convert()
        deferred_volumes.bring_here()
        deferred_volumes.look_for_newer()
    keep_writing()


@persistent
def stop_writing(*_: object) -> None:
    """Handler of save_pre, which may copy the files elsewhere."""
    deferred_volumes.stop()


@persistent
def write_before_rendering(scene: bpy.types.Scene, *_: object) -> None:
    """Handler of render_init: every engine but PrimDiffusion draws the volumes."""
    if scene.render.engine != ENGINE and any_humans():
        deferred_volumes.finish()


HANDLERS = (
    ("load_post", write_after_loading),
    ("blend_import_post", write_after_importing),
    ("save_pre", stop_writing),
    ("save_post", write_soon),
    ("undo_post", write_soon),
    ("redo_post", write_soon),
    ("render_init", write_before_rendering),
)


def unregister() -> None:
    """Stop the timers."""
    for timer in (_tick, _bring_here_soon):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    deferred_volumes.stop()
