"""Pictures from the child: asked for by any thread, drawn one after the other, followed by whoever asked.

A thread of its own speaks with the child, so that neither Blender's render thread nor its window waits for it. The
child is started by the first picture, kept warm, and ended when nobody has asked for one in a while.
"""

from __future__ import annotations

import collections
import threading
import time
from collections.abc import Mapping
from typing import Any, Literal

from .backend import Backend
from .client import BackendClient, Died, Event, Failure, Notification, Response, Silent
from .job import CANCELLED_CODE, JobError

IDLE_S = 600.0
"""A child at rest holds about half a gigabyte; starting one takes seconds."""
CANCEL_PATIENCE_S = 15.0
"""A cancel takes effect at the end of a band; a child that takes longer than this is ended."""
LISTEN_S = 0.02
"""How late a cancel may be noticed."""
State = Literal["waiting", "starting", "drawing", "done", "failed", "cancelled"]


class Drawing:
    """One picture: wanted, under way, and at last done, failed or cancelled. Read and waited for by any thread."""

    def __init__(self, params: Mapping[str, Any]):
        self.params = dict(params)
        self.state: State = "waiting"
        self.rows = 0
        """Finished rows, from the top."""
        self.eta_s: float | None = None
        """Seconds that are left, None while unknown."""
        self.result: dict[str, Any] = {}
        """When done: seconds, and what they were spent on."""
        self.error: JobError | None = None
        self.cancel_asked_at: float | None = None
        self._news = threading.Condition()
        self._version = self._seen = 0

    @property
    def finished(self) -> bool:
        """Nothing more will happen."""
        return self.state in ("done", "failed", "cancelled")

    def wait(self, timeout_s: float) -> bool:
        """Sleeps until there is news since the last call, at most `timeout_s`; whether there is."""
        with self._news:
            self._news.wait_for(lambda: self._version != self._seen, timeout_s)
            news, self._seen = self._version != self._seen, self._version
        return news

    def cancel(self) -> None:
        """Asks for an end, which comes within a band of the picture; before the first, nothing is drawn at all."""
        if self.cancel_asked_at is None:
            self.cancel_asked_at = time.monotonic()

    def become(self, state: State, **facts: Any) -> None:
        """Moves on, and wakes those who wait. For the thread that speaks with the child."""
        with self._news:
            for name, value in facts.items():
                setattr(self, name, value)
            self.state = state
            self._version += 1
            self._news.notify_all()


class DrawingChild:
    """A child process that draws. Pictures are drawn in the order in which they were asked for."""

    def __init__(self, backend: Backend, idle_s: float = IDLE_S):
        self._backend = backend
        self._idle_s = idle_s
        self._wanted: collections.deque[Drawing] = collections.deque()
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closed = False

    def draw(self, params: Mapping[str, Any]) -> Drawing:
        """Asks for a picture (`params` of the request `draw`, docs/protocol.md) and returns at once.

        Raises RuntimeError after `close`.
        """
        drawing = Drawing(params)
        with self._wake:
            if self._closed:
                raise RuntimeError("this child has been closed: make a new one")
            self._wanted.append(drawing)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="primdiffusion draw", daemon=True)
                self._thread.start()
            self._wake.notify()
        return drawing

    @property
    def info(self) -> dict[str, Any]:
        """What the child says of itself; empty while there is none."""
        client = self._backend.client
        return client.info if client is not None else {}

    @property
    def pid(self) -> int | None:
        """The process at work or kept warm, None while there is none."""
        client = self._backend.client
        return client.pid if client is not None else None

    def close(self) -> None:
        """Ends the child for good; drawings under way become cancelled."""
        with self._wake:
            self._closed = True
            for drawing in self._wanted:
                drawing.cancel()
            self._wake.notify()
        self._backend.shutdown()

    # the thread that speaks with the child

    def _work(self) -> None:
        while (drawing := self._next()) is not None:
            if drawing.cancel_asked_at is None:
                self._draw(drawing)
            else:
                drawing.become("cancelled")

    def _next(self) -> Drawing | None:
        """The next one wanted; None after `close`. Ends an idle child."""
        with self._wake:
            while not self._wanted:
                if self._closed:
                    return None
                if not self._wake.wait(self._idle_s) and not self._wanted:
                    client = self._backend.client
                    if client is not None:
                        client.shutdown()
            return self._wanted.popleft()

    def _draw(self, drawing: Drawing) -> None:
        if self._backend.client is None:
            drawing.become("starting")
        try:
            client = self._backend.connect()
        except Exception as e:
            drawing.become("failed", error=JobError(str(e) or type(e).__name__, "", "environment"))
            return
        if drawing.cancel_asked_at is not None:
            drawing.become("cancelled")
            return
        client.poll()  # what concerned an earlier picture
        drawing.become("drawing" if client.info.get("ready") else "starting")
        request, told = client.request("draw", drawing.params), False
        while not drawing.finished:
            if drawing.cancel_asked_at is not None or self._closed:
                drawing.cancel()
                if not told:
                    client.cancel(request)
                    told = True
                self._lose_patience(client, drawing)
            client.wait(LISTEN_S)
            for event in client.poll():
                _take(event, client, request, drawing)
            if self._closed and not client.alive and not drawing.finished:
                drawing.become("cancelled")

    def _lose_patience(self, client: BackendClient, drawing: Drawing) -> None:
        if time.monotonic() - (drawing.cancel_asked_at or 0.0) > CANCEL_PATIENCE_S:
            client.kill()
            drawing.become("cancelled")


def _take(event: Event, client: BackendClient, request: int, drawing: Drawing) -> None:
    if isinstance(event, Notification) and event.method == "progress" and event.params.get("id") == request:
        drawing.become("drawing", rows=int(event.params["step"]), eta_s=event.params.get("eta_s"))
    elif isinstance(event, Response) and event.id == request:
        drawing.become("done", result=event.result, eta_s=0.0)
    elif isinstance(event, Failure) and event.id == request:
        if event.code == CANCELLED_CODE:
            drawing.become("cancelled")
        else:
            error = JobError(event.message, event.remedy, event.kind, client.stderr)
            drawing.become("failed", error=error)
    elif isinstance(event, Died):
        remedy = "render again; if it happens again, a smaller picture needs less memory"
        drawing.become("failed", error=JobError(event.message, remedy, "died", event.stderr))
    elif isinstance(event, Silent):
        client.kill()
        sentence = f"the backend hung: it said nothing for {event.seconds:.0f} s and was ended"
        drawing.become("failed", error=JobError(sentence, "render again", "hung", client.stderr))
