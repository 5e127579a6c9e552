"""The child process and the conversation with it: JSON-RPC 2.0, a message a line. Nothing here waits for the child.

Threads read the child's two outputs and write its input; `poll` hands over what has arrived and notices a death or a
silence. All public methods are for one thread (Blender's main thread).
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import json
import os
import queue
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

SILENCE_S = 20.0
"""The child sends a heartbeat every 0.5 s; importing torch from a cold disk can hold it up for seconds."""
STDERR_LINES = 200
LONGEST_POLL_GAP_S = 1.0
"""Silence counts only while we poll: a suspended laptop or a blocked Blender is not the child's fault."""
STUCK_AT_EXIT_S = 1.0


@dataclasses.dataclass(frozen=True)
class Response:
    """A request went well."""

    id: int | None
    result: Any


@dataclasses.dataclass(frozen=True)
class Failure:
    """A request went wrong; `kind` and `remedy` as the backend states them ("" where it does not)."""

    id: int | None
    code: int
    message: str
    kind: str
    remedy: str


@dataclasses.dataclass(frozen=True)
class Notification:
    """News that answers no request: progress, ready."""

    method: str
    params: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Died:
    """The child is gone, and it was not told to go; the last event of a client."""

    exit_code: int | None
    message: str
    stderr: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Silent:
    """The child lives but has said nothing for `seconds`; sent once per silence."""

    seconds: float


Event = Response | Failure | Notification | Died | Silent


def child_environment(module_path: Path | None, cache_dir: Path | None, extra: Mapping[str, str]) -> dict[str, str]:
    """The environment of a backend process: this one's, without what would lead its Python astray.

    `module_path` is the folder that holds the package `primdiffusion` (the zip's bundled `backend`); it goes before
    anything installed. `cache_dir` takes byte code and compiled kernels, so that the extension's folder stays as it is.
    """
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "PYTHONSTARTUP")}
    environment.update(PYTHONSAFEPATH="1")  # no modules from the current folder, which may be anybody's
    environment.update(PYTHONUTF8="1", PYTHONUNBUFFERED="1", PYTHONFAULTHANDLER="1")
    if module_path is not None:
        environment["PYTHONPATH"] = str(module_path)
    if cache_dir is not None:
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # torch would be compiled anew at every start
        environment.update(PYTHONPYCACHEPREFIX=str(cache_dir / "bytecode"), NUMBA_CACHE_DIR=str(cache_dir / "numba"))
    environment.update(extra)
    return environment


class BackendClient:
    """One child process. Make it, `start` it, send requests, `poll` from a timer, `shutdown` at the end."""

    def __init__(
        self,
        python: Path,
        module_path: Path | None = None,
        env: Mapping[str, str] | None = None,
        *,
        cache_dir: Path | None = None,
        silence_s: float = SILENCE_S,
    ):
        self._command = [str(python), "-m", "primdiffusion.serve"]
        self._environment = child_environment(module_path, cache_dir, env or {})
        self._silence_s = silence_s
        self._process: subprocess.Popen[bytes] | None = None
        self._incoming: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._outgoing: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._stderr: collections.deque[str] = collections.deque(maxlen=STDERR_LINES)
        self._stderr_thread: threading.Thread | None = None
        self._ids = itertools.count(1)
        self._expected_to_end = False
        self._output_ended_at: float | None = None
        self._reported_end = False
        self._heard = threading.Event()
        self._arrival = threading.Event()
        self._silence = 0.0
        self._reported_silence = False
        self._polled_at = time.monotonic()
        self._abandoned: set[int] = set()
        self.info: dict[str, Any] = {}
        """What the child said of itself: version, python, memory, and device once torch is loaded (`ready`)."""

    def start(self) -> None:
        """Starts the child and asks it who it is; `info` fills as it answers. Raises OSError without such a Python."""
        if self._process is not None:
            raise RuntimeError("this client has been started before: make a new one")
        process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=self._environment,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
        self._process = process
        self._polled_at = time.monotonic()
        threading.Thread(target=self._write, args=(process.stdin,), name="primdiffusion stdin", daemon=True).start()
        threading.Thread(target=self._read, args=(process.stdout,), name="primdiffusion stdout", daemon=True).start()
        self._stderr_thread = threading.Thread(
            target=self._listen, args=(process.stderr,), name="primdiffusion stderr", daemon=True
        )
        self._stderr_thread.start()
        self._hello = self.request("hello", {})

    @property
    def pid(self) -> int | None:
        """The child's process id, None before `start`."""
        return self._process.pid if self._process is not None else None

    @property
    def alive(self) -> bool:
        """The child runs and can be asked for something."""
        if self._process is None or self._expected_to_end:  # one that was killed may take a moment to go
            return False
        return self._process.poll() is None and self._output_ended_at is None

    @property
    def stderr(self) -> tuple[str, ...]:
        """The last lines the child wrote to stderr (and all stray prints)."""
        return tuple(self._stderr)

    def request(self, method: str, params: Mapping[str, Any]) -> int:
        """Sends a request and returns its id; the answer comes through `poll`. A dead child answers with Died there."""
        id = next(self._ids)
        self._send({"jsonrpc": "2.0", "id": id, "method": method, "params": dict(params)})
        return id

    def cancel(self, id: int) -> None:
        """Asks the child to stop request `id`; it then fails with code -32001."""
        self.request("cancel", {"id": id})

    def abandon(self, id: int) -> None:
        """Nobody wants the answer to request `id` any more, whose cancel the child has not got round to yet."""
        self._abandoned.add(id)

    @property
    def occupied(self) -> bool:
        """The child has still to end a request that was abandoned; another one would be refused as busy."""
        return bool(self._abandoned)

    def poll(self) -> list[Event]:
        """What has happened since the last call, in order. Takes no time; call it a few times a second."""
        events: list[Event] = []
        now = time.monotonic()
        self._silence += min(now - self._polled_at, LONGEST_POLL_GAP_S)
        self._polled_at = now
        if self._heard.is_set():
            self._heard.clear()
            self._silence, self._reported_silence = 0.0, False
        for message in self._arrived():
            if message.get("id") in self._abandoned and "method" not in message:
                self._abandoned.discard(message["id"])
            else:
                events.append(self._event(message))
        events.extend(self._ending(now))
        if self.alive and self._silence > self._silence_s and not self._reported_silence:
            self._reported_silence = True
            events.append(Silent(self._silence))
        return events

    def wait(self, timeout_s: float) -> None:
        """Sleeps until the child has said something (heartbeats aside) or ended, at most `timeout_s`; then `poll`."""
        if self._arrival.wait(timeout_s):
            self._arrival.clear()

    def shutdown(self, timeout_s: float = 2.0) -> None:
        """Ends the child politely, or by force after `timeout_s`; waits no longer than that. Safe to call twice."""
        self._expected_to_end = True
        if self._process is None:
            return
        self.request("shutdown", {})
        self._outgoing.put(None)
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()

    def kill(self, patience_s: float = 1.0) -> bool:
        """Ends the child at once. It was told to go, so no Died follows.

        Waits no longer than `patience_s` for the system to take it away, gigabytes of memory with it; whether it is
        gone.
        """
        self._expected_to_end = True
        if self._process is not None:
            self._process.kill()
            self._outgoing.put(None)
        return self.gone_within(patience_s)

    def gone_within(self, seconds: float) -> bool:
        """Wait for the end of a child that was told to go; whether it has ended."""
        if self._process is None:
            return True
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:  # a busy system, or an uninterruptible wait
            return False
        return True

    # what has arrived

    def _arrived(self) -> Iterator[dict[str, Any]]:
        with contextlib.suppress(queue.Empty):
            while True:
                message = self._incoming.get_nowait()
                if message is None:
                    self._output_ended_at = time.monotonic()
                else:
                    yield message

    def _event(self, message: dict[str, Any]) -> Event:
        method, params, id = message.get("method"), message.get("params") or {}, message.get("id")
        if isinstance(method, str):
            if method == "ready":
                self.info = {**self.info, **params}
            return Notification(method, params)
        if "error" in message:
            error = message["error"]
            data = error.get("data") or {}
            return Failure(
                id, error.get("code", 0), error.get("message", ""), data.get("kind", ""), data.get("remedy", "")
            )
        result = message.get("result")
        if id == self._hello and isinstance(result, dict):
            self.info = {**result, **{name: value for name, value in self.info.items() if value is not None}}
        return Response(id, result)

    def _ending(self, now: float) -> Iterator[Died]:
        """The end of the child, once, after everything it still said."""
        if self._process is None or self._reported_end:
            return
        exit_code = self._process.poll()
        if exit_code is None and self._output_ended_at is None:
            return
        if exit_code is None and now - (self._output_ended_at or now) < STUCK_AT_EXIT_S:
            return  # the output has ended and the process is about to
        if self._output_ended_at is None:  # gone, but the reader may still hold its last words
            self._output_ended_at = now
            return
        self._reported_end = True
        self._outgoing.put(None)
        if exit_code is None:
            self._process.kill()
        if self._expected_to_end:
            return
        if self._stderr_thread is not None:
            self._stderr_thread.join(0.1)
        yield Died(exit_code, death_sentence(exit_code), self.stderr)

    # threads

    def _send(self, message: dict[str, Any]) -> None:
        self._outgoing.put(json.dumps(message).encode("utf-8") + b"\n")

    def _write(self, stdin: IO[bytes]) -> None:
        with contextlib.suppress(OSError):  # a broken pipe: the child is gone, which `poll` reports
            while (line := self._outgoing.get()) is not None:
                stdin.write(line)
                stdin.flush()
        with contextlib.suppress(OSError):
            stdin.close()

    def _read(self, stdout: IO[bytes]) -> None:
        for line in stdout:
            message = _parse(line)
            if message is None:
                self._stderr.append(f"[not a message] {line[:300].decode('utf-8', 'replace').rstrip()}")
                continue
            self._heard.set()
            if message.get("method") != "heartbeat":  # nobody may poll for hours: let nothing pile up
                self._incoming.put(message)
                self._arrival.set()
        self._incoming.put(None)
        self._arrival.set()

    def _listen(self, stderr: IO[bytes]) -> None:
        for line in stderr:
            self._stderr.append(line.decode("utf-8", "replace").rstrip())


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


def death_sentence(exit_code: int | None) -> str:
    """One sentence on how the child ended."""
    if exit_code is None:
        return "the backend closed its output and hung: it was ended"
    if exit_code in (-9, 137):
        return "the backend was killed by the system (often: out of memory)"
    if exit_code < 0:
        return f"the backend crashed (signal {-exit_code})"
    if exit_code > 0x7FFFFFFF:
        return f"the backend crashed (code {exit_code:#x})"
    return f"the backend ended by itself (exit code {exit_code})"
