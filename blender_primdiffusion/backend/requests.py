"""The child that requests share, and one request as Blender follows it: a small state machine that a timer ticks."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, Literal

from ..files.regular_files import printable
from ..files.whole_files import remove_of_process
from ..formats.answers import Progress
from .client import BackendClient, Died, ErrorResponse, Event, Notification, Response, Silent

_LONGEST_NAME = 120
"""Characters of a path in a sentence."""


def error_text(error: BaseException | str) -> str:
    """What an error says, in one line: the system's with the file first, whose name is cut if it is very long."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        name = str(error.filename)
        name = name if len(name) <= _LONGEST_NAME else f"{name[:40]}...{name[40 - _LONGEST_NAME :]}"
        return printable(f"{name}: {error.strerror[:1].lower()}{error.strerror[1:]}")
    return printable(str(error).strip())


def sentence(text: BaseException | str) -> str:
    """`text` with a full stop, and a capital unless a file's name comes first; the kind of an error without words."""
    words = error_text(text) or type(text).__name__
    first = words.split(" ")[0][:-1]
    if not ((isinstance(text, OSError) and text.filename) or any(mark in first for mark in "./\\")):
        words = words[:1].upper() + words[1:]
    return words if words.endswith((".", "!", "?")) else f"{words}."


@dataclasses.dataclass(frozen=True)
class Step:
    """How far a long piece of work is."""

    message: str
    fraction: float
    """Share of everything that is done, 0 to 1."""
    lines: tuple[str, ...] = ()
    """What there is to say since the step before."""


Steps = Generator[Step, None, str]
"""Returns a sentence on how it ended; raises RuntimeError or OSError. Closing it ends the work."""

END_S = 2.0
"""How long a child may take to end."""


class Backend:
    """The child that requests share: started at first use, kept warm, restarted after it died.

    No call waits for it.
    """

    def __init__(self, make_client: Callable[[], BackendClient]):
        """`make_client` finds a Python and returns a client not yet started."""
        self._make_client = make_client
        self._client: BackendClient | None = None
        self._ending: list[tuple[BackendClient, float, Callable[[], None]]] = []
        """Children that are ending: the time at which each is killed, and what to do once it has gone."""
        self._closed = False
        self._request: ChildRequest | None = None

    def start(self, request: ChildRequest) -> bool:
        """Make `request` the current one; False while another is running."""
        if self._request is not None and not self._request.finished:
            return False
        self._request = request
        return True

    @property
    def client(self) -> BackendClient | None:
        """The running child, if there is one; never starts one."""
        client = self._client
        return client if client is not None and client.alive else None

    def connected(self) -> BackendClient:
        """The running child, started now if there is none. Raises BackendNotFound or OSError."""
        running = self.client
        if running is not None:
            return running
        if self._closed:
            raise RuntimeError("the backend was shut down")
        client = self._make_client()
        client.start()
        self._client = client
        return client

    @property
    def log(self) -> tuple[str, ...]:
        """The last lines that the child, or the one before it, wrote to stderr."""
        return self._client.stderr if self._client is not None else ()

    def listen(self) -> list[Event]:
        """What has happened between requests: the child's end, or its silence."""
        self.reap()
        return self._client.poll() if self._client is not None else []

    def release(self) -> None:
        """End the warm child without waiting for it; the next request starts another."""
        client, self._client = self._client, None
        if client is not None:
            client.end()
            self.when_ended(client)

    def when_ended(self, client: BackendClient, afterwards: Callable[[], None] = lambda: None) -> None:
        """Call `afterwards` once a child that was asked to end has gone; kill it if it stays too long."""
        self._ending.append((client, time.monotonic() + END_S, afterwards))

    def reap(self) -> None:
        """Kill children that take too long to end; clean up after those that have gone. Never waits."""
        ending, self._ending = self._ending, []
        for client, killed_at, afterwards in ending:
            if client.gone_within(0.0):
                afterwards()
                continue
            if time.monotonic() > killed_at:
                client.kill(0.0)
            self._ending.append((client, killed_at, afterwards))

    def shutdown(self) -> None:
        """End the child for good, also one that is still starting. Waits a few seconds at most."""
        self._closed = True
        if self._client is not None:
            self._client.shutdown()
        for client, _, afterwards in self._ending:
            client.shutdown()
            afterwards()
        self._ending.clear()


State = Literal["starting", "running", "cancelling", "done", "failed", "cancelled"]
FINAL: tuple[State, ...] = ("done", "failed", "cancelled")
CANCELLED_CODE = -32001
CANCEL_PATIENCE_S = 0.35
"""A cancel takes effect at the end of a step; no step is waited for longer than this. Beside it the second in which a
cancel is done holds ticks of the timer and drawings of the window, which on a busy machine take as long."""
_KILL_PATIENCE_S = 0.05
STAGES = {
    "read": "Reading the pictures",
    "load": "Loading the model",
    "sample": "Generating",
    "encode": "Reconstructing",
    "preview": "Drawing the previews",
    "render": "Drawing the previews",
    "write": "Writing the human",
    "merge": "Merging the volumes",
    "fit": "Fitting",
}
"""The child's stages, as the panel names them."""


@dataclasses.dataclass(frozen=True)
class RequestError:
    """Why a request failed, for the user and, in `log`, for a bug report."""

    message: str
    remedy: str
    kind: str
    log: tuple[str, ...] = ()

    def __str__(self) -> str:
        return " ".join(sentence(part) for part in (self.message, self.remedy) if part)


USABLE_PYTHON = "Name a Python 3.11 or newer with PrimDiffusion's packages in the extension's preferences"


def connecting_error(error: Exception) -> RequestError:
    """The error of a request for which no child could be started."""
    remedy = USABLE_PYTHON if isinstance(error, OSError) else ""
    return RequestError(error_text(error) or type(error).__name__, remedy, getattr(error, "kind", "environment"))


class ChildRequest:
    """One request to the child. Call `tick` from a timer until `finished`; then read `result` or `error`.

    starting -> running -> done | failed;  cancel: -> cancelling -> cancelled.

    Of a method with the parameter `steps` (a sampler's) those steps are the progress, else those of every stage.
    """

    def __init__(self, backend: Backend, method: str, params: Mapping[str, Any], patience_s: float = CANCEL_PATIENCE_S):
        """Half-written files are cleared from the parameter `out_dir`, if the method has one.

        A child that is still at work `patience_s` after a cancel is killed.
        """
        self.method = method
        self._patience_s = patience_s
        self._params = dict(params)
        self._backend = backend
        self._out_dir = Path(params["out_dir"]) if "out_dir" in params else None
        self._out_dir_is_new = self._out_dir is not None and not self._out_dir.exists()
        self._client: BackendClient | None = None
        self._id: int | None = None
        self._cancel_asked_at: float | None = None
        self.state: State = "starting"
        self.step = 0
        self.total = int(params.get("steps", 1))
        self.eta_s: float | None = None
        """Seconds left, None while unknown."""
        self.message = "Starting the backend"
        self.picture: Path | None = None
        """A PNG of the human so far."""
        self.pictures: dict[int, Path] = {}
        """PNGs by index, of a method that generates several humans."""
        self.result: Any = None
        """The child's answer: a record of `formats.answers`."""
        self.error: RequestError | None = None
        if not backend.start(self):
            self._fail(RequestError("the backend is at work already", "wait for it, or cancel it first", "busy"))

    @property
    def finished(self) -> bool:
        """The state will not change again."""
        return self.state in FINAL

    @property
    def fraction(self) -> float:
        """Progress from 0 to 1."""
        return 1.0 if self.state == "done" else min(self.step / max(self.total, 1), 1.0)

    @property
    def info(self) -> dict[str, Any]:
        """What the backend reports about itself (version, device, memory); empty until it answers."""
        return self._client.info if self._client is not None else {}

    def tick(self) -> bool:
        """Read the child's messages; returns whether something visible changed. Never waits."""
        if self.finished:
            return False
        self._backend.reap()
        before = (self.state, self.step, self.total, self.eta_s, self.message, self.picture, dict(self.pictures))
        if self._client is None:
            self._tick_start()
        if self._client is not None and not self.finished:
            for event in self._client.poll():
                self._take(event)
                if self.finished:
                    break
            if self._id is None and not self.finished:
                self._ask(self._client)
        self._lose_patience()
        return before != (
            self.state, self.step, self.total, self.eta_s, self.message, self.picture, self.pictures
        )  # fmt: skip

    def cancel(self) -> None:
        """Cancel the request; call `tick` until the state is cancelled, which takes a second at most."""
        if self.finished or self._cancel_asked_at is not None:
            return
        self._cancel_asked_at = time.monotonic()
        self.state, self.message, self.eta_s = "cancelling", "Cancelling", None
        if self._client is not None and self._id is not None:
            self._client.cancel(self._id)

    # starting

    def _tick_start(self) -> None:
        if self._cancel_asked_at is not None:
            self._end("cancelled", "Cancelled")
            return
        try:
            self._client = self._backend.connected()
        except Exception as error:  # any error must reach the user
            self._fail(connecting_error(error))
        else:
            if not self._client.info.get("ready"):
                self.message = "Loading PyTorch"

    def _ask(self, client: BackendClient) -> None:
        """Send the request, once the child has ended an abandoned one."""
        if self._cancel_asked_at is not None:
            self._end("cancelled", "Cancelled")
        elif not client.occupied:
            self._id = client.request(self.method, self._params)

    # following

    def _take(self, event: Event) -> None:
        if isinstance(event, Notification) and event.method == "progress" and event.params.id == self._id:
            self._take_progress(event.params)
        elif isinstance(event, Response) and event.id == self._id:
            self.result = event.result
            self.step = self.total
            self._end("done", "Done")
        elif isinstance(event, ErrorResponse) and event.id == self._id:
            if event.code == CANCELLED_CODE:
                self._end("cancelled", "Cancelled")
            else:
                self._fail(RequestError(event.message, event.remedy, event.kind, self._log()))
        elif isinstance(event, Died):
            self._clear_leftovers()
            if self._cancel_asked_at is not None:
                self._end("cancelled", "Cancelled")
            elif self._client is not None and not self._client.info:  # it never spoke
                said = event.stderr[-1] if event.stderr else event.message
                message = f"{self._client.python} cannot run the backend: {said}"
                self._fail(RequestError(message, USABLE_PYTHON, "environment", event.stderr))
            else:
                self._fail(RequestError(event.message, "Try again, with other programs closed", "died", event.stderr))
        elif isinstance(event, Silent):
            self._kill()
            message = f"the backend hung: it sent nothing for {event.seconds:.0f} s and was ended"
            self._fail(RequestError(message, "Try again", "hung", self._log()))

    def _take_progress(self, progress: Progress) -> None:
        if self._cancel_asked_at is not None:
            return
        self.state = "running"
        self.message = STAGES.get(progress.stage, progress.stage.capitalize())
        self.eta_s = progress.eta_s
        if progress.picture is not None and progress.index is not None:
            self.pictures[progress.index] = progress.picture
        elif progress.picture is not None:
            self.picture = progress.picture
        samples = "steps" in self._params
        if not samples or progress.stage == "sample":
            self.step, self.total = progress.step, progress.total
        if samples and progress.stage == "sample":
            self.message = f"{self.message}: step {self.step} of {self.total}"

    def _lose_patience(self) -> None:
        asked, client = self._cancel_asked_at, self._client
        if self.finished or asked is None:
            return
        ready = client is not None and client.alive and client.info.get("ready")
        if time.monotonic() - asked < (self._patience_s if ready else CANCEL_PATIENCE_S):
            return
        if client is not None and self._id is not None:
            if client.info.get("ready"):
                self._kill()
            else:  # importing torch takes seconds that need not be spent again: the child drops the request after it
                client.abandon(self._id)
        self._end("cancelled", "Cancelled")

    def _kill(self) -> None:
        """Kill the child. Blender must not wait while the system frees a large process: leftovers go afterwards."""
        client = self._client
        if client is None or client.kill(_KILL_PATIENCE_S):
            self._clear_leftovers()
        else:
            self._backend.when_ended(client, self._clear_leftovers)

    def _clear_leftovers(self) -> None:
        """Remove the folder of half-written files of a killed child (see files/whole_files.py)."""
        if self._client is not None and self._out_dir is not None:
            remove_of_process(self._out_dir, self._client.pid)
            if self._out_dir_is_new:
                with contextlib.suppress(OSError):  # holds other files, or was never created
                    self._out_dir.rmdir()

    def _log(self) -> tuple[str, ...]:
        return self._client.stderr if self._client is not None else ()

    def _fail(self, error: RequestError) -> None:
        self.error = error
        self._end("failed", str(error))

    def _end(self, state: State, message: str) -> None:
        self.state, self.message, self.eta_s = state, message, None


class FinishedRequest(ChildRequest):
    """A request whose result Blender has computed itself; no child is started."""

    def __init__(self, backend: Backend, method: str, result: Any):
        """`result`: the record that the child's method answers with."""
        super().__init__(backend, method, {})
        self.result, self.step = result, self.total
        self._end("done", "Done")
