"""Jobs queued for the child: one at a time, in order."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import shutil
import tempfile
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ..places import new_backend, preference
from .job import Job
from .remedies import defect_in_the_scene, error_in_the_scene

if TYPE_CHECKING:
    from ..worker.backend import Backend
    from ..worker.request import Request, RequestError

CANCELLED = "Cancelled"
GONE = "The scene {!r} was deleted meanwhile: nothing was added. Undo the deletion and try again."
_REMEMBERED = 5


@dataclasses.dataclass
class Entry:
    """A queued job, and the scene it was queued for."""

    number: int
    """Its name for buttons."""
    job: Job
    scene: str
    scene_uid: int
    """For as long as the file is open."""
    asked_at: float
    """time.monotonic()."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a job has ended."""

    entry: Entry
    notice: str = ""
    """Message, when it succeeded or was cancelled."""
    error: RequestError | None = None
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    """"work" from the click to the child's answer, "finish" in the scene."""

    @property
    def sentence(self) -> str:
        """Why it failed; empty when it did not."""
        return str(self.error) if self.error is not None else ""

    @property
    def went_well(self) -> bool:
        """Neither failed nor cancelled."""
        return self.error is None and self.notice != CANCELLED


class Queue:
    """Owns the child and the queued jobs. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.waiting: collections.deque[Entry] = collections.deque()
        self.current: Entry | None = None
        """The running one, None between jobs."""
        self.request: Request | None = None
        """The request of `current`."""
        self.advancing = False
        """`current` has more to do before its answer may enter the scene."""
        self.outcomes: dict[str, Outcome] = {}
        """The last of each kind of job, for the panels."""
        self.last: Outcome | None = None
        self.ended: collections.deque[Outcome] = collections.deque(maxlen=_REMEMBERED)
        """The last of any kind, the latest first."""
        self.child_news = ""
        """How the child ended between works; empty when it did not."""
        self.idle_since = time.monotonic()
        self.info: dict[str, object] = {}
        """What the child said of itself; kept when it has ended."""
        self._numbers = itertools.count(1)
        self._folder: Path | None = None
        self._backend: Backend | None = None
        self._backend_python = ""

    @property
    def busy(self) -> bool:
        """A job is running or queued."""
        return self.current is not None or bool(self.waiting)

    @property
    def queued(self) -> list[Entry]:
        """The running job and the queued ones."""
        return [*([self.current] if self.current is not None else ()), *self.waiting]

    @property
    def ready(self) -> bool:
        """An answer waits to be put into the scene, by `finish`."""
        return self.request is not None and self.request.state == "done"

    def add(self, context: bpy.types.Context, job: Job) -> Entry:
        """Queue `job` for the scene of `context`."""
        scene = context.scene
        entry = Entry(next(self._numbers), job, scene.name, scene.session_uid, time.monotonic())
        self.waiting.append(entry)
        self.outcomes.pop(job.kind, None)
        return entry

    def tick(self) -> bool:
        """Take in news of the child, begin the next job; True when something visible changed. Never waits."""
        if self.current is None:
            if not self.waiting:
                return False
            self._begin(self.waiting.popleft())
            return True
        changed = self.request.tick()
        if self.request.info:
            self.info, self.child_news = self.request.info, ""
        if self.request.state == "cancelled":
            self._end(Outcome(self.current, notice=CANCELLED))
        elif self.request.state == "failed":
            self._end(Outcome(self.current, error=self.request.error))
        else:
            self.advancing = self.current.job.advance(self._folder)
        return changed

    def finish(self, context: bpy.types.Context) -> Outcome:
        """Put the answer that is `ready` into the scene of `context`. For the operator that makes the undo step."""
        entry, began = self.current, time.monotonic()
        if entry is None or not self.ready:
            raise RuntimeError("no answer waits: call tick until ready")
        notice, error = "", None
        try:
            notice = entry.job.finish(context, self.request.result or {}, self._folder)
        except (ValueError, OSError, RuntimeError) as e:
            error = error_in_the_scene(e)
        except Exception as e:
            traceback.print_exc()
            error = defect_in_the_scene(e)
        seconds = {"work": began - entry.asked_at, "finish": time.monotonic() - began}
        return self._end(Outcome(entry, notice, error, seconds))

    def refuse(self, error: RequestError) -> Outcome:
        """End the running job without looking at its answer."""
        return self._end(Outcome(self.current, error=error))

    def cancel(self, number: int = 0) -> bool:
        """Remove a queued job, or stop the running one (also number 0); whether there was such a job."""
        if self.current is not None and number in (0, self.current.number):
            if self.ready:  # and waits to enter the scene
                self._end(Outcome(self.current, notice=CANCELLED))
            else:
                self.request.cancel()
            return True
        left = [entry for entry in self.waiting if entry.number != number]
        found = len(left) < len(self.waiting)
        self.waiting = collections.deque(left)
        return found

    def listen(self) -> bool:
        """Between works: notice that the child has died or hangs; True when something visible changed. Never waits."""
        if self._backend is None or self.request is not None:
            return False
        from ..worker.client import Died, Silent

        for event in self._backend.listen():
            if isinstance(event, Died):
                self.child_news = event.message
                return True
            if isinstance(event, Silent):
                self.child_news = "the backend hung and was ended"
                self.release()
                return True
        return False

    def release(self) -> int | None:
        """End the child that is idle; its process id, None where there was none or it is running a job."""
        pid = self.child_pid
        if pid is None or self.request is not None:
            return None
        self._backend.release()
        return pid

    def drop(self) -> None:
        """Drop all jobs and end the child."""
        self.waiting.clear()
        self.current = self.request = None
        self.child_news = ""
        self._clear_folder()
        if self._backend is not None:
            self._backend.shutdown()
            self._backend = None

    def close(self) -> None:
        """End the child and forget all jobs: the extension is being disabled."""
        self.drop()
        self.outcomes.clear()
        self.ended.clear()
        self.last = None

    @property
    def child_pid(self) -> int | None:
        """The process that works or is kept warm."""
        client = self._backend.client if self._backend is not None else None
        return client.pid if client is not None else None

    @property
    def log(self) -> tuple[str, ...]:
        """The last lines that the child wrote to stderr."""
        return self._backend.log if self._backend is not None else ()

    def _begin(self, entry: Entry) -> None:
        from ..worker.request import Request

        self.current = entry
        try:
            self._folder = Path(tempfile.mkdtemp(prefix=f"{entry.job.kind}_", dir=bpy.app.tempdir or None))
            params = entry.job.params(self._folder)
        except (ValueError, OSError) as error:
            self._end(Outcome(entry, error=error_in_the_scene(error)))
            return
        self.request = Request(self._backend_for(preference("backend_python")), entry.job.method, params)

    def _end(self, outcome: Outcome) -> Outcome:
        self.outcomes[outcome.entry.job.kind] = self.last = outcome
        self.ended.appendleft(outcome)
        self.current = self.request = None
        self.idle_since = time.monotonic()
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
"""One for all windows."""
