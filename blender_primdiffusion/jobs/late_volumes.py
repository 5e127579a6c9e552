"""Volumes written after their humans stand: by a timer while the user works, or at the latest for a render."""

from __future__ import annotations

import time
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy.app.handlers import persistent

from ..backend.requests import sentence
from ..engine.engine import ENGINE
from ..places import EXTENSION
from ..scene.human import any_humans
from .windows import in_the_way, redraw

if TYPE_CHECKING:
    from ..scene.newer_volumes import NewerVolumes

ALWAYS, WHEN_RENDERING = "ALWAYS", "WHEN_RENDERING"
"""Values of the preference `volumes`."""
PAUSE_S = 0.02
"""Between two slices, at least."""
SHORTEST_S, LONGEST_S = 0.05, 0.1
"""Of a slice. In between, it is as long as the pause before it, in which Blender may have drawn."""
BLOCKED_S = 0.25
FIRST_S = 1.0
"""After a human has entered, until writing begins: views draw the human first."""


class LateVolumes:
    """The one that is being written, in slices. All methods but `finish` are for Blender's main thread."""

    def __init__(self) -> None:
        self.error = ""
        """Why volumes could not be written; empty when they could."""
        self.notice = ""
        """Which volumes are written again, and why; empty when none are."""
        self._source: Path | NewerVolumes | None = None
        self._steps: Generator[None, None, None] | None = None
        self._newer: list[NewerVolumes] = []
        self._failed: set[Path | NewerVolumes] = set()
        self._ended = 0.0

    def work(self, seconds: float) -> bool:
        """Write for about `seconds`, one step at least; whether more is left."""
        # needs numpy
        from ..scene.newer_volumes import write_again
        from ..scene.unwritten import unwritten, write_unwritten

        self.bring_here()
        sources = {**dict.fromkeys(unwritten(), write_unwritten), **dict.fromkeys(self._newer, write_again)}
        left = [source for source in sources if source not in self._failed]
        if self._source not in left:  # written by a render, or the human is gone
            self.stop()
        if not left:
            return False
        source = left[0] if self._source is None else self._source
        steps = sources[source](source) if self._steps is None else self._steps
        self._source, self._steps = source, steps
        end = time.monotonic() + seconds
        try:
            next(steps)
            while time.monotonic() < end:
                next(steps)
        except StopIteration:
            self._newer = [newer for newer in self._newer if newer != source]
            self.notice = self.notice if self._newer else ""
            self.stop()
        except (OSError, ValueError) as error:
            self._fail(source, error)
        return True

    def bring_here(self) -> None:
        """Have humans elsewhere, whose volumes are still to be written, in this .blend's own folders (see
        `collect_unwritten`)."""
        from ..scene.collect import collect_unwritten  # needs numpy

        try:
            collect_unwritten()
        except OSError as error:
            if self.error != str(error):
                print(f"PrimDiffusion: {error}")
            self.error = str(error)

    def finish(self) -> None:
        """Write all that is left, with steps of its own: renders call it from another thread."""
        from ..scene.unwritten import write_all_unwritten  # needs numpy

        self.forget_failures()
        if bpy.app.background:  # in the main thread
            self.bring_here()
        try:
            write_all_unwritten()
        except (OSError, ValueError) as error:
            self.error = str(error)
            print(f"PrimDiffusion: {error}")
        self._newer, self.notice = [], ""

    def look_for_newer(self) -> None:
        """Find volumes that only a newer Blender can read, say so once, and write at once those that viewports read."""
        from ..scene.newer_volumes import in_a_sentence, newer_volumes, write_again  # needs numpy

        known, self._newer = self._newer, newer_volumes()
        if not self._newer:
            self.notice = ""
            return
        if self._newer != known:
            self.notice = sentence(in_a_sentence(self._newer))
            print(f"PrimDiffusion: {self.notice}")
        try:
            for newer in (newer for newer in self._newer if newer.in_views):
                for _ in write_again(newer):
                    pass
        except (OSError, ValueError) as error:
            self.error, self.notice = str(error), ""
            print(f"PrimDiffusion: {error}")
        self._newer = newer_volumes()

    def forget_failures(self) -> None:
        """Try again what could not be written."""
        self._failed.clear()
        self.error = ""

    def tick(self) -> float | None:
        """The timer: a slice of writing, until all is written. Views that humans are drawn in come first."""
        from ..engine.gpu.overlay import overlay  # needs numpy

        if in_the_way() or not overlay.resting:
            return BLOCKED_S
        drawing = time.monotonic() - self._ended - PAUSE_S
        more = self.work(min(max(drawing, SHORTEST_S), LONGEST_S))
        self._ended = time.monotonic()
        return PAUSE_S if more else None

    def stop(self) -> None:
        """Stop writing; what is written stays, and the rest can be written later."""
        if self._steps is not None:
            self._steps.close()
        self._source = self._steps = None

    def _fail(self, source: Path | NewerVolumes, error: Exception) -> None:
        self.stop()
        self._failed.add(source)
        self.error, self.notice = str(error), ""
        print(f"PrimDiffusion: {error}")
        redraw()


late_volumes = LateVolumes()
"""One for all humans."""


def preferred() -> str:
    """When volumes are written: the preference, or ALWAYS."""
    addon = bpy.context.preferences.addons.get(EXTENSION)
    return getattr(addon.preferences, "volumes", ALWAYS) if addon is not None else ALWAYS


def keep_writing() -> None:
    """Have Blender write what is not written yet, unless the preference is to wait for a render."""
    if bpy.app.background or preferred() != ALWAYS or not any_humans():
        return
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=FIRST_S, persistent=True)


def _bring_here() -> None:
    if any_humans():
        late_volumes.bring_here()


def _bring_here_soon() -> float | None:
    """The timer: paths of volumes change, which must not happen while steps of undo wait."""
    if in_the_way():
        return BLOCKED_S
    _bring_here()
    return None


def _tick() -> float | None:
    return late_volumes.tick()


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
    late_volumes.forget_failures()
    write_after_importing()


@persistent
def write_after_importing(*_: object) -> None:
    """Handler of blend_import_post: humans were appended or linked."""
    _bring_here()
    if any_humans():
        late_volumes.look_for_newer()
    keep_writing()


@persistent
def stop_writing(*_: object) -> None:
    """Handler of save_pre, which may copy the files elsewhere."""
    late_volumes.stop()


@persistent
def write_before_rendering(scene: bpy.types.Scene, *_: object) -> None:
    """Handler of render_init: every engine but PrimDiffusion draws the volumes."""
    if scene.render.engine != ENGINE and any_humans():
        late_volumes.finish()


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
    late_volumes.stop()
