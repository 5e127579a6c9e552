"""One person in the making as Blender follows it: a small state machine that a timer ticks."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from .client import BackendClient, Died, Event, Failure, Notification, Response, Silent

State = Literal["starting", "running", "cancelling", "done", "failed", "cancelled"]
FINAL: tuple[State, ...] = ("done", "failed", "cancelled")
CANCELLED_CODE = -32001
CANCEL_PATIENCE_S = 15.0
"""A cancel takes effect at the end of a step; a child that takes longer than this is ended."""
STAGES = {
    "read": "Reading the pictures",
    "load": "Loading the model",
    "sample": "Generating",
    "encode": "Reconstructing",
    "preview": "Drawing the previews",
    "write": "Writing the person",
}

_PICTURE_PX = 16
EDITS = {"vary": "Varied", "interpolate": "Blended", "inpaint": "Re-dressed", "transfer": "Texture transferred"}
"""Methods of the child that make a person of a person, and what became of them."""


class Backend:
    """The child that jobs share: started at first use, kept warm, started anew after it died."""

    def __init__(self, make_client: Callable[[], BackendClient]):
        """`make_client` finds a Python and returns a client not yet started, in a thread: it must not touch bpy."""
        self._make_client = make_client
        self._lock = threading.Lock()
        self._client: BackendClient | None = None
        self._closed = False
        self._job: PersonJob | None = None

    def admit(self, job: PersonJob) -> bool:
        """Takes `job` as the one at work; False while another is."""
        if self._job is not None and not self._job.finished:
            return False
        self._job = job
        return True

    @property
    def client(self) -> BackendClient | None:
        """The running child, if there is one; never starts one."""
        client = self._client
        return client if client is not None and client.alive else None

    def connect(self) -> BackendClient:
        """The running child, started now if there is none. Takes seconds. Raises BackendNotFound or OSError."""
        with self._lock:
            running = self.client
            if running is not None:
                return running
            client = self._make_client()
            client.start()
            self._client = client
            if self._closed:
                client.shutdown()
                raise RuntimeError("the backend was shut down while it was starting")
            return client

    def shutdown(self) -> None:
        """Ends the child for good, also one that is just being started."""
        self._closed = True
        if self._client is not None:
            self._client.shutdown()


@dataclasses.dataclass(frozen=True)
class JobError:
    """Why a job failed, for the user and, in `log`, for a bug report."""

    message: str
    remedy: str
    kind: str
    log: tuple[str, ...] = ()

    def __str__(self) -> str:
        return " ".join(_sentence(part) for part in (self.message, self.remedy) if part)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


class PersonJob:
    """Makes one person in `out_dir`. Call `tick` from a timer until `finished`; then read `result` or `error`.

    starting -> running -> done | failed;  cancel: -> cancelling -> cancelled.
    """

    method: str
    """Of the child."""
    made: str
    """What became of the person, for `message`."""

    def __init__(self, backend: Backend, params: dict[str, Any], out_dir: Path, total: int):
        self._params = {**params, "out_dir": str(out_dir)}
        self._backend = backend
        self._out_dir = out_dir
        self._out_dir_is_new = not out_dir.exists()
        self._client: BackendClient | None = None
        self._request: int | None = None
        self._cancel_asked_at: float | None = None
        self.state: State = "starting"
        self.step = 0
        self.total = total
        self.eta_s: float | None = None
        """Seconds that are left, None while unknown."""
        self.message = "Starting the backend"
        self.result: dict[str, Any] | None = None
        """The child's: human, person, preview (paths), seconds and what the method adds."""
        self.error: JobError | None = None
        self._connected: BackendClient | None = None
        self._connect_error: Exception | None = None
        self._connecting = threading.Thread(target=self._connect, name="primdiffusion start", daemon=True)
        if backend.admit(self):
            self._connecting.start()
        else:
            self._fail(JobError("a person is being made already", "wait for it, or cancel it first", "busy"))

    @property
    def finished(self) -> bool:
        """Nothing more will happen."""
        return self.state in FINAL

    @property
    def fraction(self) -> float:
        """Progress from 0 to 1."""
        return 1.0 if self.state == "done" else self.step / max(self.total, 1)

    @property
    def info(self) -> dict[str, Any]:
        """What the backend says of itself (version, device, memory); empty until it answers."""
        return self._client.info if self._client is not None else {}

    def tick(self) -> bool:
        """Takes in what has happened; True if something visible changed. Never waits."""
        if self.finished:
            return False
        before = (self.state, self.step, self.total, self.eta_s, self.message)
        if self._client is None:
            self._tick_start()
        if self._client is not None and not self.finished:
            for event in self._client.poll():
                self._take(event)
                if self.finished:
                    break
            self._lose_patience()
        return before != (self.state, self.step, self.total, self.eta_s, self.message)

    def cancel(self) -> None:
        """Asks for an end; `tick` goes on until the state is cancelled (within one step of the sampler)."""
        if self.finished or self._cancel_asked_at is not None:
            return
        self._cancel_asked_at = time.monotonic()
        self.state, self.message, self.eta_s = "cancelling", "Cancelling", None
        if self._client is not None and self._request is not None:
            self._client.cancel(self._request)

    # starting

    def _connect(self) -> None:
        try:
            self._connected = self._backend.connect()
        except Exception as e:
            self._connect_error = e

    def _tick_start(self) -> None:
        if self._connecting.is_alive():
            return
        self._client = self._connected
        if self._cancel_asked_at is not None:
            self._end("cancelled", "Cancelled")
        elif self._client is None:
            sentence = str(self._connect_error) or type(self._connect_error).__name__
            self._fail(JobError(sentence, "", "environment"))
        else:
            self._ask(self._client)

    def _ask(self, client: BackendClient) -> None:
        self._request = client.request(self.method, self._params)
        if not client.info.get("ready"):
            self.message = "Loading PyTorch"

    # following

    def _take(self, event: Event) -> None:
        if isinstance(event, Notification) and event.method == "progress" and event.params.get("id") == self._request:
            self._take_progress(event.params)
        elif isinstance(event, Response) and event.id == self._request:
            self.result = event.result
            self.step, self.eta_s = self.total, 0.0
            self._end("done", f"{self.made} in {event.result['seconds']:.1f} s")
        elif isinstance(event, Failure) and event.id == self._request:
            if event.code == CANCELLED_CODE:
                self._end("cancelled", "Cancelled")
            else:
                self._fail(JobError(event.message, event.remedy, event.kind, self._log()))
        elif isinstance(event, Died):
            self._clear_leftovers()
            if self._cancel_asked_at is not None:
                self._end("cancelled", "Cancelled")
            else:
                self._fail(JobError(event.message, "Try again; the log tells more", "died", event.stderr))
        elif isinstance(event, Silent):
            self._kill()
            sentence = f"the backend hung: it said nothing for {event.seconds:.0f} s and was ended"
            self._fail(JobError(sentence, "Try again; the log tells more", "hung", self._log()))

    def _take_progress(self, params: dict[str, Any]) -> None:
        if self._cancel_asked_at is not None:
            return
        stage = params.get("stage", "")
        self.state = "running"
        self.message = STAGES.get(stage, stage)
        self.eta_s = params.get("eta_s")
        self._take_step(stage, params["step"], params["total"])

    def _take_step(self, stage: str, step: int, total: int) -> None:
        self.step, self.total = step, total

    def _lose_patience(self) -> None:
        asked = self._cancel_asked_at
        if not self.finished and asked is not None and time.monotonic() - asked > CANCEL_PATIENCE_S:
            self._kill()
            self._end("cancelled", "Cancelled; the backend did not answer and was ended")

    def _kill(self) -> None:
        if self._client is not None:
            self._client.kill()
        self._clear_leftovers()

    def _clear_leftovers(self) -> None:
        """Half-written files of a killed child lie in a folder of its own (the backend's staging.py names it so)."""
        if self._client is not None:
            shutil.rmtree(self._out_dir / f".primdiffusion-partial-{self._client.pid}", ignore_errors=True)
            if self._out_dir_is_new:
                with contextlib.suppress(OSError):  # holds other things, or never came to be
                    self._out_dir.rmdir()

    def _log(self) -> tuple[str, ...]:
        return self._client.stderr if self._client is not None else ()

    def _fail(self, error: JobError) -> None:
        self.error = error
        self._end("failed", str(error))

    def _end(self, state: State, message: str) -> None:
        self.state, self.message, self.eta_s = state, message, None


class SamplingJob(PersonJob):
    """A person whom the diffusion model draws; progress counts the sampler's steps. Its pictures are of no use here."""

    def __init__(
        self, backend: Backend, params: dict[str, Any], *, out_dir: Path, steps: int, checkpoint: Path | None = None
    ):
        if checkpoint is not None:
            params = {**params, "checkpoint": str(checkpoint)}
        super().__init__(backend, {**params, "steps": steps, "size": _PICTURE_PX}, out_dir, steps)

    def _take_step(self, stage: str, step: int, total: int) -> None:
        if stage == "sample":
            super()._take_step(stage, step, total)
            self.message = f"{self.message}: step {step} of {total}"


class GenerateJob(SamplingJob):
    """A person from noise."""

    method = "generate"
    made = "Generated"

    def __init__(
        self,
        backend: Backend,
        *,
        seed: int,
        steps: int,
        out_dir: Path,
        sampler: str = "ddim",
        asked: Mapping[str, Any] | None = None,
        checkpoint: Path | None = None,
    ):
        """`asked` are further parameters: attributes, guidance."""
        params = {"seed": seed, "sampler": sampler, **(asked or {})}
        super().__init__(backend, params, out_dir=out_dir, steps=steps, checkpoint=checkpoint)


class EditJob(SamplingJob):
    """A person made of one that exists, by one of the child's methods in EDITS."""

    def __init__(
        self,
        backend: Backend,
        method: str,
        person: Path,
        asked: Mapping[str, Any],
        *,
        out_dir: Path,
        steps: int,
        checkpoint: Path | None = None,
    ):
        """`person` is the backend's file of whom to edit, `asked` the method's other parameters."""
        self.method, self.made = method, EDITS[method]
        params = {**asked, "person": str(person)}
        super().__init__(backend, params, out_dir=out_dir, steps=steps, checkpoint=checkpoint)


class ReconstructJob(PersonJob):
    """A person from captures; progress counts reading, loading, encoding and writing."""

    method = "reconstruct"
    made = "Reconstructed"

    def __init__(
        self,
        backend: Backend,
        *,
        capture: Path,
        out_dir: Path,
        subject: str | None = None,
        frame: int = 0,
        views: int = 8,
        checkpoint: Path | None = None,
    ):
        params: dict[str, Any] = {"capture": str(capture), "frame": frame, "views": views}
        if subject is not None:
            params["subject"] = subject
        if checkpoint is not None:
            params["checkpoint"] = str(checkpoint)
        super().__init__(backend, params, out_dir, 4)
