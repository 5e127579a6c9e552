"""Pictures drawn by the child process, one after another, at the request of any thread.

There is no thread for it: the caller that waits for a picture (Blender's render thread or a timer of its window) also
exchanges messages with the child, one caller at a time (`DrawingChild.advance`). The first picture starts the child,
which stays warm until no picture has been requested for a while.
"""

from __future__ import annotations

import collections
import time
from collections.abc import Callable, Generator, Mapping
from typing import Any, Literal

from ..formats.answers import DrawAnswer
from .client import BackendClient, Died, ErrorResponse, Event, Notification, Response, Silent
from .requests import CANCELLED_CODE, Backend, RequestError, connecting_error

IDLE_S = 600.0
"""A child at rest holds about half a gigabyte; starting one takes seconds."""
CANCEL_PATIENCE_S = 15.0
"""A cancel takes effect at the end of a band; a child that takes longer than this is ended."""
LISTEN_S = 0.01
"""Between two looks at the child while a picture is waited for."""
State = Literal["waiting", "starting", "drawing", "done", "failed", "cancelled"]


class Drawing:
    """One requested picture, which ends as done, failed or cancelled. Any thread may read it or wait for it."""

    def __init__(self, params: Mapping[str, Any], advance: Callable[[], None] = lambda: None):
        """`advance` exchanges messages with the child that draws this picture; it never waits."""
        self.params = dict(params)
        self.state: State = "waiting"
        self.rows = 0
        """Finished rows, from the top."""
        self.eta_s: float | None = None
        """Seconds left, None while unknown."""
        self.result = DrawAnswer()
        """Once done: the seconds it took, by stage."""
        self.error: RequestError | None = None
        self.cancel_asked_at: float | None = None
        self._advance = advance
        self._version = self._seen = 0

    @property
    def finished(self) -> bool:
        """The state will not change again."""
        return self.state in ("done", "failed", "cancelled")

    def wait(self, timeout_s: float) -> bool:
        """Wait until something has changed since the last call, at most `timeout_s`; returns whether it has."""
        end = time.monotonic() + timeout_s
        while True:
            self._advance()
            if self._version != self._seen:
                self._seen = self._version
                return True
            left = end - time.monotonic()
            if left <= 0:
                return False
            time.sleep(min(left, LISTEN_S))

    def cancel(self) -> None:
        """Cancel the picture. Takes effect at the end of a band; before the first band nothing is drawn."""
        if self.cancel_asked_at is None:
            self.cancel_asked_at = time.monotonic()
            self._advance()

    def become(self, state: State, **facts: Any) -> None:
        """Change the state. Only the thread that holds the turn may call this."""
        for name, value in facts.items():
            setattr(self, name, value)
        self.state = state
        self._version += 1


class DrawingChild:
    """A child process that draws pictures in the order they were requested."""

    def __init__(self, backend: Backend, idle_s: float = IDLE_S):
        self._backend = backend
        self._idle_s = idle_s
        self._wanted: collections.deque[Drawing] = collections.deque()
        self._current: Drawing | None = None
        self._connecting: Generator[None, None, BackendClient] | None = None
        self._client: BackendClient | None = None
        """The child that draws `_current`."""
        self._request = 0
        self._cancel_sent = False
        self._idle_since = time.monotonic()
        self._closed = False
        self._turn: collections.deque[None] = collections.deque([None])
        """The thread that has taken the one element may exchange messages with the child; taking it is atomic."""

    def draw(self, params: Mapping[str, Any]) -> Drawing:
        """Request a picture (`params` of the request `draw`, docs/design/protocol.md) and returns at once.

        Raises RuntimeError after `close`.
        """
        if self._closed:
            raise RuntimeError("this child has been closed: make a new one")
        drawing = Drawing(params, self.advance)
        self._wanted.append(drawing)
        self.advance()
        return drawing

    @property
    def info(self) -> dict[str, Any]:
        """What the child reports about itself; empty while there is no child."""
        client = self._backend.client
        return client.info if client is not None else {}

    @property
    def pid(self) -> int | None:
        """Process id of the child, busy or warm; None while there is no child."""
        client = self._backend.client
        return client.pid if client is not None else None

    def close(self) -> None:
        """End the child for good and cancel its drawings."""
        self._closed = True
        self.advance()
        self._backend.shutdown()

    def advance(self) -> None:
        """Read the child's messages, request the next picture, end an idle child. Never waits.

        For any thread; does nothing while another thread holds the turn.
        """
        try:
            self._turn.popleft()
        except IndexError:
            return
        try:
            self._backend.reap()
            while (drawing := self._next()) is not None:
                self._follow(drawing)
                if not drawing.finished:
                    return
                self._current, self._idle_since = None, time.monotonic()
            self._rest()
        finally:
            self._turn.append(None)

    # only for the thread that holds the turn

    def _next(self) -> Drawing | None:
        """The current drawing, or else the next one requested."""
        if self._current is None and self._wanted:
            self._current, self._client, self._cancel_sent = self._wanted.popleft(), None, False
        return self._current

    def _rest(self) -> None:
        """End a child that has been idle for too long."""
        if self._backend.client is not None and time.monotonic() - self._idle_since > self._idle_s:
            self._backend.release()

    def _follow(self, drawing: Drawing) -> None:
        if self._closed or (self._client is None and drawing.cancel_asked_at is not None):
            drawing.become("cancelled")  # a child that is being started is there for the next one
        elif self._client is None:
            self._start(drawing)
        else:
            self._listen(self._client, drawing)

    def _start(self, drawing: Drawing) -> None:
        if self._connecting is None:
            self._connecting = self._backend.connecting()
            if self._backend.client is None:
                drawing.become("starting")
        try:
            next(self._connecting)
        except StopIteration as connected:
            self._connecting, self._client = None, connected.value
            self._ask(connected.value, drawing)
        except Exception as e:
            self._connecting = None
            drawing.become("failed", error=connecting_error(e))

    def _ask(self, client: BackendClient, drawing: Drawing) -> None:
        client.poll()  # what concerned an earlier picture
        drawing.become("drawing" if client.info.get("ready") else "starting")
        self._request = client.request("draw", drawing.params)

    def _listen(self, client: BackendClient, drawing: Drawing) -> None:
        if drawing.cancel_asked_at is not None:
            if not self._cancel_sent:
                client.cancel(self._request)
                self._cancel_sent = True
            if time.monotonic() - drawing.cancel_asked_at > CANCEL_PATIENCE_S:
                client.kill(0.0)
                drawing.become("cancelled")
                return
        for event in client.poll():
            _take(event, client, self._request, drawing)


def _take(event: Event, client: BackendClient, request: int, drawing: Drawing) -> None:
    if isinstance(event, Notification) and event.method == "progress" and event.params.id == request:
        drawing.become("drawing", rows=event.params.step, eta_s=event.params.eta_s)
    elif isinstance(event, Response) and event.id == request:
        drawing.become("done", result=event.result, eta_s=0.0)
    elif isinstance(event, ErrorResponse) and event.id == request:
        if event.code == CANCELLED_CODE:
            drawing.become("cancelled")
        else:
            error = RequestError(event.message, event.remedy, event.kind, client.stderr)
            drawing.become("failed", error=error)
    elif isinstance(event, Died):
        remedy = "render again; if it happens again, a smaller picture needs less memory"
        drawing.become("failed", error=RequestError(event.message, remedy, "died", event.stderr))
    elif isinstance(event, Silent):
        client.kill(0.0)
        sentence = f"the backend hung: it sent nothing for {event.seconds:.0f} s and was ended"
        drawing.become("failed", error=RequestError(sentence, "render again", "hung", client.stderr))
