"""Jobs for the child, what becomes of their results, and the queue that runs one at a time, in order."""

from __future__ import annotations

import abc
import collections
import contextlib
import dataclasses
import itertools
import os
import platform
import tempfile
import time
import tomllib
import traceback
from pathlib import Path
from typing import Any

import bpy

from ..backend.client import Died, Silent
from ..backend.environment import NOT_ABSOLUTE
from ..backend.requests import Backend, ChildRequest, FinishedRequest, RequestError, error_text, sentence
from ..files.regular_files import is_local_path, remove_folder
from ..places import EXTENSION, new_backend, preference

PREVIEW_PX = 16
"""Size of the child's previews, pixels; most jobs do not use them."""


class Job(abc.ABC):
    """A request to the child, and what becomes of its result. Holds plain data: undo replaces Blender's objects."""

    kind: str
    """Identifies the kind of job, for panels; unique."""
    method: str
    """The child's method."""
    undo: str = ""
    """Name of the undo step that `finish` makes; empty when it leaves the scene as it is."""

    @property
    @abc.abstractmethod
    def label(self) -> str:
        """Shown in panels: Human, seed 7."""

    @abc.abstractmethod
    def params(self, folder: Path) -> dict[str, Any]:
        """Parameters of the child's method when the job starts; `folder` is for its files, empty, and removed
        after `finish`. Raises ValueError or OSError where the job is no longer possible."""

    @abc.abstractmethod
    def finish(self, context: bpy.types.Context, result: Any, folder: Path) -> str:
        """Put the child's answer, a record of `formats.answers`, into the scene; returns a message for the panel.

        Runs inside an operator, in object mode where `undo` is given; that operator makes the undo step. ValueError,
        OSError and RuntimeError become the panel's error, and must leave the scene as it was.
        """

    def result_here(self, folder: Path) -> Any:
        """The answer where Blender can compute it itself, in less than a second; None to request it from the child.

        `folder` as in `params`. Raises ValueError or OSError."""
        return None

    def advance(self, folder: Path) -> bool:
        """Process some of the files that the child has written so far, for a timer's tick at most; whether there is
        more to do now. Called while the child is running, and afterwards until nothing is left, before `finish`."""
        return False


def chosen_checkpoint() -> str:
    """The file of the preference `checkpoint`; empty for the bundled one.

    Raises ValueError for a path that depends on the open .blend or the working directory.
    """
    chosen = preference("checkpoint")
    if chosen and not is_local_path(chosen):
        raise ValueError(NOT_ABSOLUTE.format("a checkpoint", chosen[:200]))
    return chosen


_LOG_LINES = 40
"""Lines of the child's output in the file for a bug report."""
CANCELLED = "Cancelled"
GONE = "The scene {!r} was deleted meanwhile: nothing was added. Undo the deletion and try again."


@dataclasses.dataclass
class Entry:
    """A queued job, and the scene it was queued for."""

    number: int
    """Identifies it in operators."""
    job: Job
    scene: str
    scene_uid: int
    """Valid while the file is open."""


@dataclasses.dataclass(frozen=True)
class JobOutcome:
    """How a job ended."""

    entry: Entry
    notice: str = ""
    """Message, when it succeeded or was cancelled."""
    error: RequestError | None = None

    @property
    def sentence(self) -> str:
        """Why it failed; empty when it did not."""
        return error_text(self.error) if self.error is not None else ""

    @property
    def succeeded(self) -> bool:
        """Neither failed nor cancelled."""
        return self.error is None and self.notice != CANCELLED


def error_in_the_scene(error: Exception) -> RequestError:
    """The error of a result that could not enter the scene; an exception may have an attribute `kind`."""
    return RequestError(sentence(error), "", str(getattr(error, "kind", "scene")))


def error_log() -> Path:
    """The file for a bug report about the last error."""
    return Path(bpy.app.tempdir or tempfile.gettempdir()) / "primdiffusion_error.txt"


class Queue:
    """Owns the child and the queued jobs. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.waiting: collections.deque[Entry] = collections.deque()
        self.current: Entry | None = None
        """The running one, None between jobs."""
        self.request: ChildRequest | None = None
        """The request of `current`."""
        self.advancing = False
        """`current` has more to do before its result may enter the scene."""
        self.outcomes: dict[str, JobOutcome] = {}
        """The last of each kind of job, for the panels."""
        self.last: JobOutcome | None = None
        self.child_message = ""
        """How the child ended between jobs; empty when it did not."""
        self.idle_since = time.monotonic()
        self.info: dict[str, object] = {}
        """What the child reported about itself, also after it has ended."""
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
        """A result is ready for `finish`, which puts it into the scene."""
        return self.request is not None and self.request.state == "done"

    def add(self, context: bpy.types.Context, job: Job) -> Entry:
        """Queue `job` for the scene of `context`."""
        scene = context.scene
        entry = Entry(next(self._numbers), job, scene.name, scene.session_uid)
        self.waiting.append(entry)
        self.outcomes.pop(job.kind, None)
        return entry

    def tick(self) -> bool:
        """Process the child's messages, start the next job; True when something visible changed. Never waits."""
        if self.current is None:
            if not self.waiting:
                return False
            self._begin(self.waiting.popleft())
            return True
        changed = self.request.tick()
        if self.request.info:
            self.info, self.child_message = self.request.info, ""
        if self.request.state == "cancelled":
            self._end(JobOutcome(self.current, notice=CANCELLED))
        elif self.request.state == "failed":
            self._end(JobOutcome(self.current, error=self.request.error))
        else:
            self.advancing = self.current.job.advance(self._folder)
        return changed

    def finish(self, context: bpy.types.Context) -> JobOutcome:
        """Put the result that is `ready` into the scene of `context`. For the operator that makes the undo step."""
        entry = self.current
        if entry is None or not self.ready:
            raise RuntimeError("no result is ready: call tick until ready")
        notice, error = "", None
        try:
            notice = sentence(entry.job.finish(context, self.request.result, self._folder))
        except (ValueError, OSError, RuntimeError) as e:
            error = error_in_the_scene(e)
        except Exception as e:
            traceback.print_exc()
            trace = tuple(traceback.format_exc().splitlines())
            error = RequestError(f"the result could not be put into the scene: {sentence(e)}", "", "scene", trace)
        return self._end(JobOutcome(entry, notice, error))

    def fail(self, error: RequestError) -> JobOutcome:
        """End the running job with an error, whatever its result."""
        return self._end(JobOutcome(self.current, error=error))

    def cancel(self, number: int = 0) -> bool:
        """Remove a queued job, or stop the running one (also number 0); whether there was such a job."""
        if self.current is not None and number in (0, self.current.number):
            if self.ready:  # about to enter the scene
                self._end(JobOutcome(self.current, notice=CANCELLED))
            else:
                self.request.cancel()
            return True
        left = [entry for entry in self.waiting if entry.number != number]
        found = len(left) < len(self.waiting)
        self.waiting = collections.deque(left)
        return found

    def listen(self) -> bool:
        """Between jobs: notice that the child has died or hangs; True when something visible changed. Never waits."""
        if self._backend is None or self.request is not None:
            return False
        for event in self._backend.listen():
            if isinstance(event, Died):
                self.child_message = event.message
                return True
            if isinstance(event, Silent):
                self.child_message = "the backend hung and was ended"
                self.release()
                return True
        return False

    def release(self) -> bool:
        """End the idle child; whether there was one."""
        if self.child_pid is None or self.request is not None:
            return False
        self._backend.release()
        return True

    def drop(self) -> None:
        """Drop all jobs and end the child."""
        self.waiting.clear()
        self.current = self.request = None
        self.child_message = ""
        self._clear_folder()
        if self._backend is not None:
            self._backend.shutdown()
            self._backend = None

    def close(self) -> None:
        """End the child and forget all jobs: the extension is being disabled."""
        self.drop()
        self.outcomes.clear()
        self.last = None

    @property
    def child_pid(self) -> int | None:
        """Process id of the running child, if any."""
        client = self._backend.client if self._backend is not None else None
        return client.pid if client is not None else None

    @property
    def log(self) -> tuple[str, ...]:
        """The last lines that the child wrote to stderr."""
        return self._backend.log if self._backend is not None else ()

    def _begin(self, entry: Entry) -> None:
        self.current = entry
        try:
            self._folder = Path(tempfile.mkdtemp(prefix=f"{entry.job.kind}_", dir=bpy.app.tempdir or None))
            params, result = entry.job.params(self._folder), entry.job.result_here(self._folder)
        except (ValueError, OSError) as error:
            self._end(JobOutcome(entry, error=error_in_the_scene(error)))
            return
        backend, method = self._backend_for(preference("backend_python")), entry.job.method
        if result is None:
            self.request = ChildRequest(backend, method, params)
        else:
            self.request = FinishedRequest(backend, method, result)

    def _end(self, outcome: JobOutcome) -> JobOutcome:
        if outcome.error is not None:
            self._write_error_log(outcome.entry.job.label, outcome.error)
        self.outcomes[outcome.entry.job.kind] = self.last = outcome
        self.current = self.request = None
        self.idle_since = time.monotonic()
        self._clear_folder()
        return outcome

    def _write_error_log(self, job: str, error: RequestError) -> None:
        """Write what a bug report needs into the file `error_log`. The home folder is written as "~"."""
        with open(Path(__file__).resolve().parents[1] / "blender_manifest.toml", "rb") as manifest:
            version = tomllib.load(manifest)["version"]
        about = {name: self.info.get(name, "?") for name in ("version", "python", "torch", "device_name")}
        lines = [
            f"PrimDiffusion {version} ({'extension' if EXTENSION.startswith('bl_ext.') else 'from source'})",
            f"Blender {bpy.app.version_string} ({bpy.app.build_hash.decode(errors='replace')})",
            f"System {platform.platform()}, {platform.machine()}, {os.cpu_count()} processors",
            "Backend {version}, Python {python}, torch {torch}, device {device_name}".format(**about),
            f"{job} ({error.kind}): {error_text(error)}",
            *(f"    {line}" for line in (error.log or self.log)[-_LOG_LINES:]),
        ]
        with contextlib.suppress(OSError):  # the disk may be full
            error_log().write_text("\n".join(lines).replace(str(Path.home()), "~"), encoding="utf-8")

    def _clear_folder(self) -> None:
        if self._folder is not None:
            remove_folder(self._folder, self._folder.parent)
            self._folder = None

    def _backend_for(self, python: str) -> Backend:
        """The child of this interpreter; changing the preference ends the one before."""
        if self._backend is not None and python == self._backend_python:
            return self._backend
        if self._backend is not None:
            self._backend.shutdown()
        self._backend, self._backend_python = new_backend(python), python
        return self._backend


queue = Queue()
"""One for all windows."""
