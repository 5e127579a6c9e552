"""The child's side of the conversation: JSON-RPC 2.0 on stdin and stdout, a message a line (docs/design/protocol.md).

    reader thread     parses lines; answers hello, cancel and shutdown itself, so they work while a request runs
    main thread       loads torch, then runs one request at a time of REQUESTS
    heartbeat thread  a notification every 0.5 s, so that the other side can tell busy from hung

`hello` answers before torch is loaded: `device` is null until a `ready` notification brings it (or `problem`, a
sentence, where the environment is broken). A second request meanwhile fails with kind "busy". The child ends when its
stdin does, because then its parent is gone. Stray prints go to stderr: file descriptor 1 is moved away first of all.
"""

from __future__ import annotations

import dataclasses
import os
import platform
import queue
import sys
import threading
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn, TypeVar

from primdiffusion import __version__
from primdiffusion.commands.edit import InpaintRequest, InterpolateRequest, TransferRequest, VaryRequest
from primdiffusion.commands.export import GaussiansRequest, HumanNpzRequest, ProxyRequest
from primdiffusion.commands.generate import GenerateRequest, VariationsRequest
from primdiffusion.commands.info import AttributesRequest
from primdiffusion.commands.merge import FitGainRequest, MergeFramesRequest, MergeRequest
from primdiffusion.commands.reconstruct import ReconstructRequest
from primdiffusion.commands.render import DrawRequest, RenderRequest
from primdiffusion.commands.request import ParameterError, Request, read_record, read_request
from primdiffusion.failures import Failure, describe
from primdiffusion.machine import memory, share_processors
from primdiffusion.serve.rpc import (
    CANCELLED,
    DOMAIN_ERROR,
    INTERNAL_ERROR,
    INVALID_PARAMS,
    METHOD_NOT_FOUND,
    MalformedRequest,
    RpcError,
    RpcRequest,
    Wire,
    parse_request,
)

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session

R = TypeVar("R")
PROTOCOL = 1
HEARTBEAT_S = 0.5
REQUESTS: dict[str, type[Request]] = {
    "generate": GenerateRequest,
    "variations": VariationsRequest,
    "attributes": AttributesRequest,
    "vary": VaryRequest,
    "interpolate": InterpolateRequest,
    "inpaint": InpaintRequest,
    "transfer": TransferRequest,
    "reconstruct": ReconstructRequest,
    "render": RenderRequest,
    "draw": DrawRequest,
    "merge": MergeRequest,
    "merge_frames": MergeFramesRequest,
    "fit_gain": FitGainRequest,
    "proxy": ProxyRequest,
    "gaussians": GaussiansRequest,
    "human_npz": HumanNpzRequest,
}
"""By method; they run on the main thread, one at a time."""
GRACE_S = 3.0
"""After the parent is gone a request has this long to reach its next step and tidy up; then the process ends anyway."""


@dataclasses.dataclass(frozen=True)
class NoParams:
    """Parameters of hello and shutdown."""


@dataclasses.dataclass(frozen=True)
class CancelParams:
    """Parameters of cancel."""

    id: str | int | float


class Cancelled(Exception):
    """Raised in a request at work at its next step after a cancel."""


@dataclasses.dataclass
class Running:
    """The request at work."""

    message: RpcRequest
    request: Request
    cancelled: threading.Event = dataclasses.field(default_factory=threading.Event)


class Server:
    """One conversation: lines from `source`, messages to `wire`."""

    def __init__(self, source: BinaryIO, wire: Wire):
        self._source = source
        self._wire = wire
        self._queue: queue.SimpleQueue[Running | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._running: Running | None = None
        self._ended = threading.Event()
        self._state: dict[str, Any] = {"ready": False, "problem": None, "device": None, "device_name": None}
        self._methods: dict[str, Callable[[RpcRequest], None]] = {
            "hello": self._hello,
            "cancel": self._cancel,
            "shutdown": self._shutdown,
            **dict.fromkeys(REQUESTS, self._accept),
        }

    def run(self) -> None:
        """Serves until shutdown, or the end of the input or of the output. Call from the main thread."""
        threading.Thread(target=self._read, name="reader", daemon=True).start()
        threading.Thread(target=self._beat, name="heartbeat", daemon=True).start()
        session = self._warm_up()
        while (running := self._queue.get()) is not None:
            self._work(session, running)

    # reader thread

    def _read(self) -> None:
        for line in iter(self._source.readline, b""):
            if not line.strip() or self._ended.is_set():
                continue
            try:
                self._dispatch(line)
            except OSError:
                break  # the output is gone, and with it the parent
        self._end()

    def _dispatch(self, line: bytes) -> None:
        try:
            message = parse_request(line)
        except MalformedRequest as e:
            self._wire.fail(e.id, e)
            return
        try:
            method = self._methods.get(message.method)
            if method is None:
                known = ", ".join(self._methods)
                raise RpcError(METHOD_NOT_FOUND, f"there is no method {message.method!r}: the methods are {known}")
            method(message)
        except OSError:
            raise
        except Exception as e:
            self._fail(message, _as_rpc_error(e))

    def _hello(self, message: RpcRequest) -> None:
        _parameters(read_record, NoParams, message)
        about = {"name": "primdiffusion", "version": __version__, "protocol": PROTOCOL, "pid": os.getpid()}
        python = {"python": platform.python_version(), "executable": sys.executable}
        self._respond(message, {**about, **python, **memory(), **self._state})

    def _cancel(self, message: RpcRequest) -> None:
        params = _parameters(read_record, CancelParams, message)
        with self._lock:  # also while answering, so that the answer comes before the end of the request
            found = self._running is not None and self._running.message.id == params.id
            if found and self._running is not None:
                self._running.cancelled.set()
            self._respond(message, {"cancelled": found})

    def _shutdown(self, message: RpcRequest) -> None:
        _parameters(read_record, NoParams, message)
        self._respond(message, {})
        self._end()

    def _accept(self, message: RpcRequest) -> None:
        running = Running(message, _parameters(read_request, REQUESTS[message.method], message))
        with self._lock:
            if self._running is not None:
                sentence = f"the backend is at work on request {self._running.message.id!r}: one at a time"
                raise RpcError(DOMAIN_ERROR, sentence, {"kind": "busy", "remedy": "wait for it, or cancel it first"})
            self._running = running
        self._queue.put(running)

    def _end(self) -> None:
        """A request at work may tidy up first; with none there is nothing to wait for, not even torch being loaded."""
        self._ended.set()
        with self._lock:
            if self._running is None:
                _leave(0)
            self._running.cancelled.set()
        self._queue.put(None)
        threading.Timer(GRACE_S, _leave, [0]).start()

    # heartbeat thread

    def _beat(self) -> None:
        while not self._ended.wait(HEARTBEAT_S):
            try:
                self._wire.notify("heartbeat")
            except OSError:
                self._end()

    # main thread

    def _warm_up(self) -> Session | RpcError:
        """Imports torch and all that needs it; a broken environment becomes the error of every later request."""
        try:
            # after `hello` can be answered
            from primdiffusion.commands import frame_drawer, output  # noqa: F401  loaded before the first request
            from primdiffusion.commands.session import Session

            session = Session()
        except Exception as e:
            error = _as_rpc_error(e)
            self._state = {**self._state, "problem": str(error)}
            self._notify("ready", **self._state)
            return error
        self._state = {**self._state, "ready": True, **session.device_info()}
        self._notify("ready", **self._state)
        return session

    def _work(self, session: Session | RpcError, running: Running) -> None:
        def report(stage: str, step: int, total: int, eta_s: float | None, /, **more: Any) -> None:
            if running.cancelled.is_set():
                raise Cancelled
            self._notify("progress", id=running.message.id, stage=stage, step=step, total=total, eta_s=eta_s, **more)

        try:
            if isinstance(session, RpcError):
                raise session
            result = running.request.run(session, report)
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
            self._wire.respond(message.id, result)

    def _fail(self, message: RpcRequest, error: RpcError) -> None:
        if message.wants_response:
            self._wire.fail(message.id, error)

    def _notify(self, method: str, **params: Any) -> None:
        self._wire.notify(method, **params)


def _parameters(read: Callable[[type[R], dict[str, Any], str], R], record: type[R], message: RpcRequest) -> R:
    """The parameters of a message; ValueErrors of reading become RpcError(INVALID_PARAMS)."""
    try:
        return read(record, message.params, message.method)
    except ParameterError as e:
        raise RpcError(INVALID_PARAMS, str(e)) from e
    except ValueError as e:
        raise RpcError(INVALID_PARAMS, f"{message.method!r}: {e}") from e


def _as_rpc_error(error: Exception) -> RpcError:
    """The error as a response carries it; the traceback goes to stderr, where the client keeps the last lines."""
    if isinstance(error, RpcError):
        return error
    traceback.print_exception(error, file=sys.stderr)
    failure = describe(error)
    if failure is None:
        sentence = f"defect in the backend: {type(error).__name__}: {error}"
        remedy = "report it with the lines of the backend's log"
        return RpcError(INTERNAL_ERROR, sentence, {"kind": "defect", "remedy": remedy})
    return RpcError(DOMAIN_ERROR, failure.sentence, _data(failure))


def _data(failure: Failure) -> dict[str, str]:
    return {"kind": failure.kind, "remedy": failure.remedy}


def guard_streams() -> tuple[BinaryIO, BinaryIO]:
    """Moves the conversation away from file descriptors 0 and 1, so that no print, and no C library, can disturb it.

    Afterwards descriptor 1 leads to stderr and descriptor 0 to nothing. Returns the conversation's source and sink.
    """
    sys.stdout.flush()
    source, sink = os.dup(0), os.dup(1)
    os.dup2(2, 1)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    return os.fdopen(source, "rb"), os.fdopen(sink, "wb")


def main() -> None:
    """Serves on stdin and stdout until the other side is done."""
    share_processors()
    source, sink = guard_streams()
    status = 0
    try:
        Server(source, Wire(sink)).run()
    except KeyboardInterrupt:
        status = 130
    except OSError as e:
        print(f"the other end of the pipe is gone: {e}", file=sys.stderr)
    _leave(status)


def _leave(status: int) -> NoReturn:
    """Ends the process from any thread. An ordinary exit would wait for the lock of a reader blocked on the pipe."""
    sys.stderr.flush()
    os._exit(status)
