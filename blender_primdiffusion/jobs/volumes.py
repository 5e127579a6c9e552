"""Volumes are written when something shows them: for 3D views by a job in slices, for renders before they begin."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..engine.engine import ENGINE
from ..files.regular_files import printable
from ..scene.human import HumanTarget, all_humans
from ..scene.payload import session_file
from ..scene.representation import show_in_viewport
from ..scene.volume_nodes import open_humans, set_folder, volumes_of, write_volumes, writing
from .queue import Job

SLICE_S = 0.08
"""Longest writing between two of Blender's own events, seconds."""


@dataclasses.dataclass
class VolumesJob(Job):
    """Write a human's volumes, then show them in 3D views."""

    kind = method = "volumes"
    undo = "Volumes in Viewport"

    target: HumanTarget
    _steps: Generator[None, None, None] | None = None
    _error: Exception | None = None

    @property
    def label(self) -> str:
        return f"Volumes of {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        return {}

    def result_here(self, folder: Path) -> Any:
        self._steps = writing(self.target.found())
        return self.label

    def advance(self, folder: Path) -> bool:
        end = time.monotonic() + SLICE_S
        try:
            while self._error is None and time.monotonic() < end:
                next(self._steps)
        except StopIteration:
            return False
        except (OSError, ValueError) as error:  # `finish` reports it
            self._error = error
        return self._error is None

    def finish(self, _context: bpy.types.Context, _result: str, folder: Path) -> str:
        while self.advance(folder):
            pass
        if self._error is not None:
            raise self._error
        person = self.target.found()
        show_in_viewport(person, True)
        set_folder(person, session_file(person).parent, again=True)
        return f"3D views show the volumes of {person.name}"


class Faults:
    """What is wrong with humans of the open file, or with their volumes; empty when nothing is."""

    text = ""

    def report(self, text: str) -> None:
        """Say it once in the console, and in the panel."""
        if self.text != text:
            print(printable(f"PrimDiffusion: {text}"))
        self.text = text


faults = Faults()


def write_or_report(person: bpy.types.Object) -> None:
    """Write a human's volumes; says why where that fails."""
    try:
        write_volumes(person)
    except (OSError, ValueError) as error:
        faults.report(str(error))


@persistent
def open_after_loading(*_: object) -> None:
    """Handler of load_post."""
    faults.text = ""
    open_after_importing()


@persistent
def open_after_importing(*_: object) -> None:
    """Handler of blend_import_post: humans were appended or linked."""
    for fault in open_humans():
        faults.report(fault)


@persistent
def write_before_rendering(scene: bpy.types.Scene, *_: object) -> None:
    """Handler of render_init: every engine but PrimDiffusion draws the volumes. With a window it runs in the render's
    thread, where no data may be made."""
    if scene.render.engine == ENGINE:
        return
    faults.text = ""
    for person in all_humans():  # scenes may hold instances of them alone
        volumes = volumes_of(person)
        if volumes is not None and not volumes.hide_render:
            write_or_report(person)


HANDLERS = (
    ("load_post", open_after_loading),
    ("blend_import_post", open_after_importing),
    ("render_init", write_before_rendering),
)


def unregister() -> None:
    """Forget what was wrong: another file may be open when the extension is enabled again."""
    faults.text = ""
