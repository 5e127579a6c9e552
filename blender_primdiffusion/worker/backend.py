"""The child that jobs share: started at first use, kept warm, started anew after it died."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

from .client import BackendClient, Event


class Job(Protocol):
    """What the child is at work on."""

    @property
    def finished(self) -> bool:
        """Nothing more will happen."""
        ...


class Backend:
    """The child that jobs share: started at first use, kept warm, started anew after it died."""

    def __init__(self, make_client: Callable[[], BackendClient]):
        """`make_client` finds a Python and returns a client not yet started, in a thread: it must not touch bpy."""
        self._make_client = make_client
        self._lock = threading.Lock()
        self._client: BackendClient | None = None
        self._closed = False
        self._job: Job | None = None

    def admit(self, job: Job) -> bool:
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

    @property
    def log(self) -> tuple[str, ...]:
        """The last lines that the child, or the one before it, wrote to stderr."""
        return self._client.stderr if self._client is not None else ()

    def listen(self) -> list[Event]:
        """What has happened while nobody is at work: the child's end, or its silence."""
        return self._client.poll() if self._client is not None else []

    def release(self) -> None:
        """Ends the child that is kept warm, without waiting for it; the next job starts another."""
        client, self._client = self._client, None
        if client is not None:  # its farewell takes a moment, in which Blender would stand still
            threading.Thread(target=client.shutdown, name="primdiffusion end", daemon=True).start()

    def shutdown(self) -> None:
        """Ends the child for good, also one that is just being started."""
        self._closed = True
        if self._client is not None:
            self._client.shutdown()
