"""The child that requests share: started at first use, kept warm, started anew after it died."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from typing import Protocol

from .client import BackendClient, Event
from .polling import run_to_end

END_S = 2.0
"""What a child that was asked to end may take for it."""


class Request(Protocol):
    """A request to the child."""

    @property
    def finished(self) -> bool:
        """Nothing more will happen."""
        ...


class Backend:
    """The child that requests share: started at first use, kept warm, started anew after it died.

    Blender may be closed between any two calls, so what takes long is a generator that yields while it waits.
    """

    def __init__(self, make_client: Callable[[], Generator[None, None, BackendClient]]):
        """`make_client` finds a Python and returns a client not yet started; yields while it looks for one."""
        self._make_client = make_client
        self._client: BackendClient | None = None
        self._leaving: list[tuple[BackendClient, float, Callable[[], None]]] = []
        """Each with the time at which it is killed, and what is to be done after it has gone."""
        self._closed = False
        self._request: Request | None = None

    def admit(self, request: Request) -> bool:
        """Takes `request` as the one at work; False while another is."""
        if self._request is not None and not self._request.finished:
            return False
        self._request = request
        return True

    @property
    def client(self) -> BackendClient | None:
        """The running child, if there is one; never starts one."""
        client = self._client
        return client if client is not None and client.alive else None

    def connecting(self) -> Generator[None, None, BackendClient]:
        """The running child, started now if there is none, which takes seconds. Raises BackendNotFound or OSError."""
        running = self.client
        if running is not None:
            return running
        client = yield from self._make_client()
        if self._closed:
            raise RuntimeError("the backend was shut down while it was starting")
        client.start()
        self._client = client
        return client

    def connect(self) -> BackendClient:
        """As `connecting`, for callers that wait."""
        return run_to_end(self.connecting())

    @property
    def log(self) -> tuple[str, ...]:
        """The last lines that the child, or the one before it, wrote to stderr."""
        return self._client.stderr if self._client is not None else ()

    def listen(self) -> list[Event]:
        """What has happened between requests: the child's end, or its silence."""
        self.see_off()
        return self._client.poll() if self._client is not None else []

    def release(self) -> None:
        """Ends the child that is kept warm, without waiting for it; the next request starts another."""
        client, self._client = self._client, None
        if client is not None:
            client.end()
            self.part_with(client)

    def part_with(self, client: BackendClient, afterwards: Callable[[], None] = lambda: None) -> None:
        """Do `afterwards` when a child that was asked to end has gone; see to it that it goes."""
        self._leaving.append((client, time.monotonic() + END_S, afterwards))

    def see_off(self) -> None:
        """Look after children that are about to end. Takes no time."""
        leaving, self._leaving = self._leaving, []
        for client, killed_at, afterwards in leaving:
            if client.gone_within(0.0):
                afterwards()
                continue
            if time.monotonic() > killed_at:
                client.kill(0.0)
            self._leaving.append((client, killed_at, afterwards))

    def shutdown(self) -> None:
        """Ends the child for good, also one that is just being started. Waits for its end some seconds at most."""
        self._closed = True
        if self._client is not None:
            self._client.shutdown()
        for client, _, afterwards in self._leaving:
            client.shutdown()
            afterwards()
        self._leaving.clear()
