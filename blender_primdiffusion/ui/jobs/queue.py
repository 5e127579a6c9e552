"""Works in line for the child: one at a time, in the order in which they were asked for."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import shutil
import tempfile
import time
import traceback
from pathlib import Path

import bpy

from ...places import new_backend, preference
from ...worker.backend import Backend
from ...worker.job import Job, JobError
from ...worker.sentence import sentence
from .work import Work

IN_LINE = "In line"
GONE = "The scene {!r} was deleted meanwhile: nothing was added. Undo the deletion and try again."


@dataclasses.dataclass
class Entry:
    """A work in line, and where it was asked for."""

    number: int
    """Its name for buttons."""
    work: Work
    scene: str
    scene_uid: int
    """For as long as the file is open."""
    blend: str
    """Path of the file it was asked for in; empty for one never saved."""
    asked_at: float
    """time.monotonic()."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a work has ended."""

    entry: Entry
    notice: str = ""
    """News, when it went well or was cancelled."""
    error: JobError | None = None
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    """"work" from the click to the child's answer, "finish" in the scene."""

    @property
    def sentence(self) -> str:
        """Why it failed; empty when it did not."""
        return str(self.error) if self.error is not None else ""


class Queue:
    """Owns the child and the line. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.waiting: collections.deque[Entry] = collections.deque()
        self.current: Entry | None = None
        """At work, None between works."""
        self.job: Job | None = None
        """The request of `current`."""
        self.outcomes: dict[str, Outcome] = {}
        """The last of each kind of work, for the panels."""
        self.last: Outcome | None = None
        self.info: dict[str, object] = {}
        """What the child said of itself; kept when it has ended."""
        self._numbers = itertools.count(1)
        self._folder: Path | None = None
        self._backend: Backend | None = None
        self._backend_python = ""

    @property
    def busy(self) -> bool:
        """Something is at work or waits for its turn."""
        return self.current is not None or bool(self.waiting)

    @property
    def ready(self) -> bool:
        """An answer waits to be put into the scene, by `finish`."""
        return self.job is not None and self.job.state == "done"

    def add(self, context: bpy.types.Context, work: Work) -> Entry:
        """Put `work` in line for the scene of `context`; nothing is asked of the child before the next `tick`."""
        scene = context.scene
        entry = Entry(next(self._numbers), work, scene.name, scene.session_uid, bpy.data.filepath, time.monotonic())
        self.waiting.append(entry)
        self.outcomes.pop(work.kind, None)
        return entry

    def tick(self) -> bool:
        """Take in news of the child, begin the next work; True when something visible changed. Never waits."""
        if self.current is None:
            if not self.waiting:
                return False
            self._begin(self.waiting.popleft())
            return True
        changed = self.job.tick()
        if self.job.info:
            self.info = self.job.info
        if self.job.state == "cancelled":
            self._end(Outcome(self.current, notice="Cancelled"))
        elif self.job.state == "failed":
            self._end(Outcome(self.current, error=self.job.error))
        return changed

    def finish(self, context: bpy.types.Context) -> Outcome:
        """Put the answer that is `ready` into the scene of `context`. For the operator that makes the undo step."""
        entry, began = self.current, time.monotonic()
        if entry is None or not self.ready:
            raise RuntimeError("no answer waits: call tick until ready")
        notice, error = "", None
        try:
            notice = entry.work.finish(context, self.job.result or {}, self._folder)
        except (ValueError, OSError, RuntimeError) as e:
            error = JobError(sentence(e), "", "scene")
        except Exception as e:
            traceback.print_exc()
            error = JobError(f"The result could not be put into the scene: {sentence(e)}", "", "scene")
        seconds = {"work": began - entry.asked_at, "finish": time.monotonic() - began}
        return self._end(Outcome(entry, notice, error, seconds))

    def refuse(self, error: JobError) -> Outcome:
        """End the work at hand without looking at its answer."""
        return self._end(Outcome(self.current, error=error))

    def cancel(self, number: int = 0) -> bool:
        """Take a work out of the line, or ask the child to stop; 0: what is at work. Whether there was such a one."""
        if self.current is not None and number in (0, self.current.number):
            self.job.cancel()
            return True
        left = [entry for entry in self.waiting if entry.number != number]
        found = len(left) < len(self.waiting)
        self.waiting = collections.deque(left)
        return found

    def close(self) -> None:
        """Drop all works and end the child: the extension is going, or another file is loaded."""
        self.waiting.clear()
        self.current = self.job = None
        self._clear_folder()
        if self._backend is not None:
            self._backend.shutdown()
            self._backend = None

    @property
    def child_pid(self) -> int | None:
        """The process that works or is kept warm."""
        client = self._backend.client if self._backend is not None else None
        return client.pid if client is not None else None

    def _begin(self, entry: Entry) -> None:
        self.current = entry
        try:
            self._folder = Path(tempfile.mkdtemp(prefix=f"{entry.work.kind}_", dir=bpy.app.tempdir or None))
            params = entry.work.params(self._folder)
        except (ValueError, OSError) as error:
            self._end(Outcome(entry, error=JobError(sentence(error), "", "bad_input")))
            return
        self.job = Job(self._backend_for(preference("backend_python")), entry.work.method, params)

    def _end(self, outcome: Outcome) -> Outcome:
        self.outcomes[outcome.entry.work.kind] = self.last = outcome
        self.current = self.job = None
        self._clear_folder()
        return outcome

    def _clear_folder(self) -> None:
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def _backend_for(self, python: str) -> Backend:
        """The child of this interpreter; changing the preference ends the former one."""
        if self._backend is not None and python == self._backend_python:
            return self._backend
        if self._backend is not None:
            self._backend.shutdown()
        self._backend, self._backend_python = new_backend(python), python
        return self._backend


queue = Queue()
"""Blender has one main thread and one user: one line."""
