"""The child process and the conversation with it: JSON-RPC 2.0, a message a line. Nothing here waits for the child.

`poll` reads what the child has written (see `child_process`), sends what its input takes, and notices a death or a
silence. All public methods are for one thread at a time.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import json
import subprocess
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..files.json_files import parse_message
from ..formats.answers import ANSWERS, NOTIFICATIONS, ErrorData, Message
from ..formats.schema import FieldError, read
from .child_process import COMPUTING, LOG_LINES, LONGEST_LINE, Input, Output, passed_on

PROGRAM = "primdiffusion"
"""The backend's package, and its command line."""
PATIENCE_S = 2.0
"""How long a child that was asked to end may take."""
SILENCE_S = 20.0
"""The child sends a heartbeat every 0.5 s; importing torch from a cold disk can hold it up for seconds."""
LONGEST_POLL_GAP_S = 1.0
"""Silence counts only while we poll: a suspended laptop or a blocked Blender is not the child's fault."""
POLL_S = 0.05
"""Longest parsing in one call of `poll`, seconds: a flood of messages is taken in over several."""


@dataclasses.dataclass(frozen=True)
class Response:
    """A request went well."""

    id: int
    result: Any
    """A record of `formats.answers`; an object of JSON for a method that is not there."""


@dataclasses.dataclass(frozen=True)
class ErrorResponse:
    """A request went wrong; `kind` and `remedy` as the backend states them ("" where it does not)."""

    id: int
    code: int
    message: str
    kind: str
    remedy: str


@dataclasses.dataclass(frozen=True)
class Notification:
    """News that answers no request: progress, ready."""

    method: str
    params: Any
    """A record of `formats.answers`; an object of JSON for a method that is not there."""


@dataclasses.dataclass(frozen=True)
class Died:
    """The child is gone, and it was not asked to end; the last event of a client."""

    exit_code: int
    message: str
    stderr: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Silent:
    """The child lives but has sent nothing for `seconds`; sent once per silence."""

    seconds: float


Event = Response | ErrorResponse | Notification | Died | Silent


def is_program(path: Path) -> bool:
    """Whether a path is that of the backend's command line, instead of a Python's."""
    return path.stem.lower() == PROGRAM


def child_environment(module_path: Path | None, cache_dir: Path | None, extra: Mapping[str, str]) -> dict[str, str]:
    """The environment of a backend process: the variables that `passed_on` gives, ours, and `extra`.

    `module_path` is the folder that holds the package `primdiffusion` (`bundled` in the zip); it goes before
    anything installed. `cache_dir` takes compiled kernels. Byte code stays beside its sources: an installed torch
    has it, and compiling it once more took 7 s of the first press.
    """
    environment = passed_on(COMPUTING)
    environment.update(PYTHONSAFEPATH="1")  # never import from the current folder
    environment.update(PYTHONUTF8="1", PYTHONUNBUFFERED="1", PYTHONFAULTHANDLER="1")
    if module_path is not None:
        environment["PYTHONPATH"] = str(module_path)
    if cache_dir is not None:
        environment.update(NUMBA_CACHE_DIR=str(cache_dir / "numba"))
    environment.update(extra)
    return environment


class BackendClient:
    """One child process, of a Python or of the program `primdiffusion`.

    Make it, `start` it, send requests, `poll` from a timer, `shutdown` at the end.
    """

    def __init__(
        self,
        python: Path,
        module_path: Path | None = None,
        env: Mapping[str, str] | None = None,
        *,
        cache_dir: Path | None = None,
        silence_s: float = SILENCE_S,
    ):
        self.python = python
        """The child's Python, or its program."""
        self._command = [str(python), "serve"] if is_program(python) else [str(python), "-m", f"{PROGRAM}.serve"]
        self._environment = child_environment(module_path, cache_dir, env or {})
        self._silence_s = silence_s
        self._process: subprocess.Popen[bytes] | None = None
        self._input: Input | None = None
        self._output: Output | None = None
        self._errors: Output | None = None
        self._lines: collections.deque[bytes] = collections.deque()
        self._stray: collections.deque[str] = collections.deque(maxlen=LOG_LINES)
        self._last_errors: tuple[str, ...] = ()
        self._ids = itertools.count(1)
        self._expected_to_end = False
        self._ended = False
        self._silence = 0.0
        self._reported_silence = False
        self._polled_at = time.monotonic()
        self._abandoned: set[int] = set()
        self._asked: dict[int, str] = {}
        """Methods of the requests that have had no answer, by id."""
        self.info: dict[str, Any] = {}
        """What the child reported about itself: version, python, memory, and device once torch is loaded (`ready`)."""

    def start(self) -> None:
        """Starts the child and asks it who it is; `info` fills as it answers. Raises OSError without such a Python."""
        if self._process is not None:
            raise RuntimeError("this client has been started before: make a new one")
        output, errors = Output(), Output()
        try:
            process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=output.target,
                stderr=errors.target,
                bufsize=0,
                env=self._environment,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError:
            output.close()
            errors.close()
            raise
        output.target.close()
        errors.target.close()
        assert process.stdin is not None
        self._process = process
        self._input, self._output, self._errors = Input(process.stdin), output, errors
        self._polled_at = time.monotonic()
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
        return self._process.poll() is None

    @property
    def stderr(self) -> tuple[str, ...]:
        """The last lines the child wrote to stderr, and lines on stdout that are not messages."""
        errors = self._last_errors if self._errors is None else self._errors.log()
        return (*self._stray, *errors)

    def request(self, method: str, params: Mapping[str, Any]) -> int:
        """Sends a request and returns its id; the answer comes through `poll`. A dead child answers with Died there."""
        id = next(self._ids)
        self._asked[id] = method
        self._send({"jsonrpc": "2.0", "id": id, "method": method, "params": dict(params)})
        return id

    def cancel(self, id: int) -> None:
        """Asks the child to stop request `id`; it then fails with code -32001."""
        self.request("cancel", {"id": id})

    def abandon(self, id: int) -> None:
        """Drop the answer to request `id`, whose cancel the child has not come to yet."""
        self._abandoned.add(id)

    @property
    def occupied(self) -> bool:
        """The child is still ending an abandoned request and would reject another one as busy."""
        return bool(self._abandoned)

    def poll(self) -> list[Event]:
        """What has happened since the last call, in order. Takes no time; call it a few times a second."""
        events: list[Event] = []
        now = time.monotonic()
        self._silence += min(now - self._polled_at, LONGEST_POLL_GAP_S)
        self._polled_at = now
        if self._process is None or self._ended:
            return events
        if self._input is not None:
            self._input.flush()
        exit_code = self._process.poll()  # before reading: then all that it wrote is there
        try:
            for event in self._arrived():
                self._silence, self._reported_silence = 0.0, False
                if isinstance(event, Response | ErrorResponse) and event.id in self._abandoned:
                    self._abandoned.discard(event.id)
                elif not (isinstance(event, Notification) and event.method == "heartbeat"):
                    events.append(event)
        except ValueError as fault:
            return [*events, *self._give_up(str(fault))]
        if exit_code is not None and not self._lines and self._output is not None and self._output.at_end:
            events.extend(self._end(exit_code))
        elif self.alive and self._silence > self._silence_s and not self._reported_silence:
            self._reported_silence = True
            events.append(Silent(self._silence))
        return events

    def end(self) -> None:
        """Asks the child to end, without waiting for it: by a request, and by the end of its input."""
        self._expected_to_end = True
        if self._input is not None:
            self.request("shutdown", {})
            self._input.close()

    def shutdown(self) -> None:
        """Ends the child politely, or by force after PATIENCE_S; waits no longer than that. Safe to call twice."""
        self.end()
        if not self.gone_within(PATIENCE_S):
            self.kill()

    def kill(self, patience_s: float = 1.0) -> bool:
        """Ends the child at once; no Died follows.

        Waits no longer than `patience_s` for the system to take it away, gigabytes of memory with it; whether it is
        gone.
        """
        self._expected_to_end = True
        if self._process is not None:
            self._process.kill()
            if self._input is not None:
                self._input.close()
        return self.gone_within(patience_s)

    def gone_within(self, seconds: float) -> bool:
        """Wait for the end of a child that was asked to end; whether it has ended."""
        if self._process is None:
            return True
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:  # a busy system, or an uninterruptible wait
            return False
        self._close_streams()
        return True

    # what has arrived

    def _arrived(self) -> Iterator[Event]:
        """Messages, for POLL_S at most. Raises ValueError."""
        end = time.monotonic() + POLL_S
        while self._output is not None:
            if not self._lines:
                self._lines.extend(self._output.lines())
                if self._output.lost_message:
                    raise ValueError(f"longer than {LONGEST_LINE >> 20} MB")
                if not self._lines:
                    return
            line = self._lines.popleft()
            if line.lstrip().startswith(b"{"):
                yield self._event(line)
            elif line.strip():
                self._stray.append(f"[not a message] {line[:300].decode('utf-8', 'replace').rstrip()}")
            if time.monotonic() > end:
                return

    def _event(self, line: bytes) -> Event:
        """Read a message. Raises ValueError."""
        try:
            return self._read(read(Message, parse_message(line)))
        except FieldError as fault:
            raise ValueError(fault.field) from fault
        except ValueError as error:
            raise ValueError("not JSON") from error

    def _read(self, message: Message) -> Event:
        """Raises FieldError."""
        if message.method is not None:
            params = _record(NOTIFICATIONS.get(message.method), message.params or {})
            if message.method == "ready":
                self.info |= _given(params)
            return Notification(message.method, params)
        method = self._asked.pop(message.id or 0, None)
        if message.id is None or method is None:
            raise FieldError(("id",), "is of no open request")  # it was answered before, or our line was not understood
        if message.error is not None:
            data = message.error.data or ErrorData()
            return ErrorResponse(message.id, message.error.code, message.error.message, data.kind, data.remedy)
        if message.result is None:
            raise FieldError(("result",), "is missing")
        result = _record(ANSWERS.get(method), message.result)
        if message.id == self._hello:
            self.info = _given(result) | self.info
        return Response(message.id, result)

    def _end(self, exit_code: int) -> Iterator[Event]:
        """The end of the child, once, after its last messages."""
        self._ended = True
        last = self._output.rest() if self._output is not None else b""
        if last.lstrip().startswith(b"{"):
            with contextlib.suppress(ValueError):  # cut off by its death
                yield self._event(last)
        self._close_streams()
        if not self._expected_to_end:
            yield Died(exit_code, death_sentence(exit_code), self.stderr)

    def _give_up(self, fault: str) -> Iterator[Event]:
        """End a child whose messages cannot be trusted: the last event, unless it was to end anyway."""
        expected, errors = self._expected_to_end, self.stderr
        self.kill(0.0)
        self._ended = True
        self._lines.clear()
        if not expected:
            yield Died(0, f"the backend was ended because it sent a malformed message ({fault})", errors)

    def _close_streams(self) -> None:
        if self._errors is not None:
            self._last_errors = tuple(self._errors.log())
        for stream in (self._input, self._output, self._errors):
            if stream is not None:
                stream.close()
        self._input = self._output = self._errors = None

    def _send(self, message: dict[str, Any]) -> None:
        if self._input is not None:
            self._input.send(json.dumps(message).encode("utf-8") + b"\n")


def _record(record: type | None, values: dict[str, Any]) -> Any:
    return values if record is None else read(record, values)


def _given(record: Any) -> dict[str, Any]:
    return {name: value for name, value in vars(record).items() if value is not None}


def death_sentence(exit_code: int) -> str:
    """One sentence on how the child ended."""
    if exit_code in (-9, 137):
        return "the backend was killed by the system (often: out of memory)"
    if exit_code < 0:
        return f"the backend crashed (signal {-exit_code})"
    if exit_code > 0x7FFFFFFF:
        return f"the backend crashed (code {exit_code:#x})"
    return f"the backend ended by itself (exit code {exit_code})"
