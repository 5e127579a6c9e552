"""The child process: JSON-RPC 2.0 on stdin and stdout (docs/design/protocol.md).

A message is a line of UTF-8 JSON without line breaks (json escapes them). There are no batches.

    reader thread     parses lines; answers hello, cancel and shutdown itself, so that they work while a request runs
    main thread       loads torch, then runs one request at a time
    heartbeat thread  sends a notification every 0.5 s, so that the client can tell busy from hung

`hello` is answered before torch is loaded: `device` is null until the `ready` notification, which has a `problem` if
the environment is broken. A second request while one is running fails with kind "busy". The child exits when its stdin
closes, because its parent has exited. File descriptor 1 is redirected to stderr, so that prints do no harm.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import platform
import queue
import sys
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

from primdiffusion.commands import FUNCTIONS, function_of, open_session
from primdiffusion.files.json_files import LARGEST_BYTES, parse_message
from primdiffusion.files.regular_files import printable
from primdiffusion.formats.answers import CancelAnswer, Done, HelloAnswer, Progress, Ready
from primdiffusion.formats.requests import REQUESTS
from primdiffusion.formats.schema import FieldError, read, written
from primdiffusion.runtime.failures import shorten, to_user_error, traceback_of
from primdiffusion.runtime.machine import memory, share_processors
from primdiffusion.version import __version__

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session

PARSE_ERROR = -32700
INVALID_REQUEST = -32600
METHOD_NOT_FOUND = -32601
INVALID_PARAMS = -32602
INTERNAL_ERROR = -32603
CANCELLED = -32001
DOMAIN_ERROR = -32002
"""An error of a request rather than the protocol; `data.kind` is its kind, `data.remedy` what to do next."""
PROTOCOL = 1
HEARTBEAT_S = 0.5
LONGEST_LINE = LARGEST_BYTES + 2
"""Bytes read of a line; a longer one is answered as no JSON, and its rest is skipped."""
SHUTDOWN_TIMEOUT_S = 3.0
"""Time for a running request to stop and clean up when the parent has exited; then the process exits anyway."""

JsonId = str | int | float | None


class RpcError(Exception):
    """The error of a response: a code, one sentence, and data for programs.

    Of a line that is not a request, `id` is the request's if it could be read, as JSON-RPC requires.
    """

    def __init__(self, code: int, message: str, data: dict[str, Any] | None = None, *, id: JsonId = None):
        super().__init__(message)
        self.code, self.data, self.id = code, data, id

    def as_object(self) -> dict[str, Any]:
        """The `error` member of a response."""
        error: dict[str, Any] = {"code": self.code, "message": str(self)}
        return error if self.data is None else {**error, "data": self.data}


@dataclasses.dataclass(frozen=True)
class RpcRequest:
    """A parsed message."""

    method: str
    params: dict[str, Any]
    id: JsonId
    wants_response: bool
    """False for notifications, which have no `id` member at all."""


def parse_request(line: bytes) -> RpcRequest:
    """Parse a line. Raises RpcError unless it is one JSON-RPC 2.0 request object."""
    try:
        message = parse_message(line)
    except ValueError as e:
        raise RpcError(PARSE_ERROR, f"the line is not JSON in UTF-8 ({e!s:.160}): send one JSON object a line") from e
    if isinstance(message, list):
        raise RpcError(INVALID_REQUEST, "batches are not supported: send one request a line")
    if not isinstance(message, dict):
        raise RpcError(INVALID_REQUEST, f"a request is a JSON object, not {type(message).__name__}")
    id = message.get("id")
    if isinstance(id, bool) or not isinstance(id, str | int | float | None):
        raise RpcError(INVALID_REQUEST, f"a request's id is a string or a number, not {type(id).__name__}")
    if isinstance(id, float) and not math.isfinite(id):
        raise RpcError(INVALID_REQUEST, f"a request's id is a finite number, not {id}")
    if message.get("jsonrpc") != "2.0":
        raise RpcError(INVALID_REQUEST, 'a request needs "jsonrpc": "2.0"', id=id)
    method, params = message.get("method"), message.get("params", {})
    if not isinstance(method, str):
        raise RpcError(INVALID_REQUEST, "a request needs a method name", id=id)
    if not isinstance(params, dict):
        raise RpcError(INVALID_PARAMS, f"params of {method!r:.60} must be a JSON object with names", id=id)
    return RpcRequest(method, params, id, "id" in message)


class Wire:
    """Writes whole lines from any thread."""

    def __init__(self, stream: BinaryIO):
        self._stream = stream
        self._lock = threading.Lock()

    def _send(self, message: dict[str, Any]) -> None:
        line = json.dumps({"jsonrpc": "2.0", **message}, allow_nan=False).encode("utf-8") + b"\n"
        with self._lock:
            self._stream.write(line)
            self._stream.flush()

    def respond(self, id: JsonId, result: Any) -> None:
        """Send the result of a request."""
        self._send({"id": id, "result": result})

    def fail(self, id: JsonId, error: RpcError) -> None:
        """Send the error of a request."""
        self._send({"id": id, "error": error.as_object()})

    def notify(self, method: str, **params: Any) -> None:
        """Send a notification."""
        self._send({"method": method, "params": params})


class Cancelled(Exception):
    """Raised in a running request at the first step after a cancel."""


@dataclasses.dataclass
class Running:
    """The running request."""

    message: RpcRequest
    request: Any
    """A record of `formats.requests`."""
    cancelled: threading.Event = dataclasses.field(default_factory=threading.Event)


class Server:
    """Serves one client: lines from `source`, messages to `wire`."""

    def __init__(self, source: BinaryIO, wire: Wire):
        self._source = source
        self._wire = wire
        self._queue: queue.SimpleQueue[Running | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._running: Running | None = None
        self._ended = threading.Event()
        self._state = Ready()
        self._methods: dict[str, Callable[[RpcRequest], None]] = {
            "hello": self._hello,
            "cancel": self._cancel,
            "shutdown": self._shutdown,
            **dict.fromkeys(REQUESTS.keys() & FUNCTIONS.keys(), self._accept),
        }

    def run(self) -> None:
        """Serve until shutdown or until input or output is closed. Call from the main thread."""
        threading.Thread(target=self._read, name="reader", daemon=True).start()
        threading.Thread(target=self._send_heartbeats, name="heartbeat", daemon=True).start()
        session = self._warm_up()
        while (running := self._queue.get()) is not None:
            self._run_request(session, running)

    # reader thread

    def _read(self) -> None:
        whole = True
        for line in iter(lambda: self._source.readline(LONGEST_LINE), b""):
            begins, whole = whole, line.endswith(b"\n") or len(line) < LONGEST_LINE
            if not begins or not line.strip() or self._ended.is_set():
                continue  # the rest of a line whose beginning was answered
            try:
                self._dispatch(line)
            except OSError:
                break  # the parent has exited
        self._end()

    def _dispatch(self, line: bytes) -> None:
        try:
            message = parse_request(line)
        except RpcError as e:
            self._wire.fail(e.id, e)
            return
        try:
            method = self._methods.get(message.method)
            if method is None:
                known = ", ".join(self._methods)
                raise RpcError(METHOD_NOT_FOUND, f"there is no method {message.method!r:.40}: the methods are {known}")
            method(message)
        except OSError:
            raise
        except Exception as e:
            self._fail(message, _as_rpc_error(e))

    def _hello(self, message: RpcRequest) -> None:
        _parameters(message)
        about = {"name": "primdiffusion", "version": __version__, "protocol": PROTOCOL, "pid": os.getpid()}
        python = {"python": platform.python_version(), "executable": sys.executable}
        self._respond(message, HelloAnswer(**about, **python, **memory(), **vars(self._state)))

    def _cancel(self, message: RpcRequest) -> None:
        params = _parameters(message)
        with self._lock:  # also while responding, so that the response precedes that of the request
            found = self._running is not None and self._running.message.id == params.id
            if found and self._running is not None:
                self._running.cancelled.set()
            self._respond(message, CancelAnswer(cancelled=found))

    def _shutdown(self, message: RpcRequest) -> None:
        _parameters(message)
        self._respond(message, Done())
        self._end()

    def _accept(self, message: RpcRequest) -> None:
        running = Running(message, _parameters(message))
        with self._lock:
            if self._running is not None:
                sentence = f"the backend is running request {self._running.message.id!r}: one at a time"
                raise RpcError(DOMAIN_ERROR, sentence, {"kind": "busy", "remedy": "wait for it, or cancel it first"})
            self._running = running
        self._queue.put(running)

    def _end(self) -> None:
        """Exit at once without a running request, otherwise after SHUTDOWN_TIMEOUT_S for it to clean up."""
        self._ended.set()
        with self._lock:
            if self._running is None:
                _exit(0)
            self._running.cancelled.set()
        self._queue.put(None)
        threading.Timer(SHUTDOWN_TIMEOUT_S, _exit, [0]).start()

    # heartbeat thread

    def _send_heartbeats(self) -> None:
        while not self._ended.wait(HEARTBEAT_S):
            try:
                self._wire.notify("heartbeat")
            except OSError:
                self._end()

    # main thread

    def _warm_up(self) -> Session | RpcError:
        """Import torch and what needs it; an import error becomes the error of every later request."""
        try:
            started = open_session()
            function_of("render")  # loads what most requests need before the first one
        except Exception as e:
            error = _as_rpc_error(e)
            self._state = Ready(problem=str(error))
            self._notify("ready", self._state)
            return error
        self._state = Ready(ready=True, **started.device_info())
        self._notify("ready", self._state)
        return started

    def _run_request(self, session: Session | RpcError, running: Running) -> None:
        def report(stage: str, step: int, total: int, eta_s: float | None, /, **more: Any) -> None:
            if running.cancelled.is_set():
                raise Cancelled
            id = running.message.id
            self._notify("progress", Progress(id=id, stage=stage, step=step, total=total, eta_s=eta_s, **more))

        try:
            if isinstance(session, RpcError):
                raise session
            result = function_of(running.message.method)(running.request, session, report)
        except Cancelled:
            outcome: Any = RpcError(CANCELLED, "cancelled")
        except Exception as e:
            outcome = _as_rpc_error(e)
        else:
            outcome = result
        with self._lock:
            self._running = None
        if isinstance(outcome, RpcError):
            self._fail(running.message, outcome)
        else:
            self._respond(running.message, outcome)

    # any thread

    def _respond(self, message: RpcRequest, result: Any) -> None:
        if message.wants_response:
            self._wire.respond(message.id, written(result))

    def _fail(self, message: RpcRequest, error: RpcError) -> None:
        if message.wants_response:
            self._wire.fail(message.id, error)

    def _notify(self, method: str, params: Any) -> None:
        self._wire.notify(method, **written(params))


def _parameters(message: RpcRequest) -> Any:
    """Read the parameters of a message. Raises RpcError(INVALID_PARAMS)."""
    try:
        return read(REQUESTS[message.method], message.params, message.method)
    except FieldError as e:
        raise RpcError(INVALID_PARAMS, printable(shorten(str(e)))) from e


def _as_rpc_error(error: Exception) -> RpcError:
    """Convert an error for a response, and print its traceback to stderr, whose last lines the client keeps."""
    if isinstance(error, RpcError):
        return error
    print(traceback_of(error), end="", file=sys.stderr, flush=True)
    failure = to_user_error(error)
    if failure is None:
        sentence = printable(f"defect in the backend: {type(error).__name__}: {error}")
        remedy = "report it with the lines of the backend's log"
        return RpcError(INTERNAL_ERROR, sentence, {"kind": "defect", "remedy": remedy})
    return RpcError(DOMAIN_ERROR, failure.sentence, {"kind": failure.kind, "remedy": failure.remedy})


def guard_streams() -> tuple[BinaryIO, BinaryIO]:
    """Move the protocol away from file descriptors 0 and 1, out of reach of prints and C libraries.

    Afterwards descriptor 1 is stderr and descriptor 0 the null device. Returns the protocol's input and output.
    """
    sys.stdout.flush()
    source, sink = os.dup(0), os.dup(1)
    os.dup2(2, 1)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    return os.fdopen(source, "rb"), os.fdopen(sink, "wb")


def run(arguments: Sequence[str]) -> None:
    """`primdiffusion serve`, which has no options."""
    about = "Answer JSON-RPC requests on stdin and stdout: the backend of the Blender extension."
    argparse.ArgumentParser("primdiffusion serve", description=about).parse_args(arguments)
    main()


def main() -> None:
    """Serve on stdin and stdout until the client is done."""
    share_processors()
    source, sink = guard_streams()
    status = 0
    try:
        Server(source, Wire(sink)).run()
    except KeyboardInterrupt:
        status = 130
    except OSError as e:
        print(f"the pipe to the client is broken: {e}", file=sys.stderr)
    _exit(status)


def _exit(status: int) -> NoReturn:
    """Exit from any thread. An ordinary exit would wait for the lock of the reader, which blocks on the pipe."""
    sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    main()
