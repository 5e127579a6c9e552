"""Volumes written after their humans stand: by a timer while the user works, or at the latest for a render."""

from __future__ import annotations

import time
from collections.abc import Generator
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..engine.engine import ENGINE
from ..engine.gpu.overlay import overlay
from ..formats.regular_files import printable
from ..places import EXTENSION
from ..scene.human import any_humans
from ..scene.pending import (
    PendingVolumes,
    is_wanted,
    open_humans,
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
        """What is wrong with a human, or why volumes could not be written; empty when nothing is."""
        self._left: list[PendingVolumes] = []
        """The humans whose volumes are left to write; looked up when it is empty."""
        self._steps: Generator[None, None, None] | None = None
        self._failed: set[Path] = set()
        """Files whose volumes could not be written."""
        self._ended = 0.0

    def work(self, seconds: float) -> bool:
        """Write for about `seconds`, one step at least; whether more is left."""
        if self._left and not is_wanted(self._left[0]):  # the human was removed, or is in another state
            self.stop()
        if not self._left:
            self._left = [one for one in pending_volumes() if one.file not in self._failed]
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
            show_written()
        except (OSError, ValueError) as error:
            self.stop()
            self._failed.add(pending.file)
            self.report(str(error))
            redraw()
        return True

    def finish(self) -> None:
        """Write all that is left, with steps of its own: renders call it from another thread."""
        self.forget_failures()
        try:
            write_all_pending()
        except (OSError, ValueError) as error:
            self.report(str(error))
        if bpy.app.background:
            show_written()

    def forget_failures(self) -> None:
        """Try again what could not be written."""
        self._failed.clear()
        self.error = ""

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

    def report(self, text: str) -> None:
        """Say what is wrong: in the console once, and in the panel."""
        if self.error != text:
            print(printable(f"PrimDiffusion: {text}"))
        self.error = text


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


def _tick() -> float | None:
    return deferred_volumes.tick()


@persistent
def write_soon(*_: object) -> None:
    """Handler of undo_post and redo_post, after which other volumes may be wanted."""
    keep_writing()


@persistent
def open_after_loading(*_: object) -> None:
    """Handler of load_post."""
    deferred_volumes.forget_failures()
    open_after_importing()


@persistent
def open_after_importing(*_: object) -> None:
    """Handler of blend_import_post: humans were appended or linked."""
    for fault in open_humans():
        deferred_volumes.report(fault)
    keep_writing()


@persistent
def write_before_rendering(scene: bpy.types.Scene, *_: object) -> None:
    """Handler of render_init: every engine but PrimDiffusion draws the volumes."""
    if scene.render.engine != ENGINE and any_humans():
        deferred_volumes.finish()


HANDLERS = (
    ("load_post", open_after_loading),
    ("blend_import_post", open_after_importing),
    ("undo_post", write_soon),
    ("redo_post", write_soon),
    ("render_init", write_before_rendering),
)


def unregister() -> None:
    """Stop the timer."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    deferred_volumes.stop()
