"""The child's side of the conversation: JSON-RPC 2.0 on stdin and stdout, a message a line (docs/design/protocol.md).

    reader thread     parses lines; answers hello, cancel and shutdown itself, so they work while a person is sampled
    main thread       loads torch, then runs one job at a time (generate, edits, reconstruct, render, draw)
    heartbeat thread  a notification every 0.5 s, so that the other side can tell busy from hung

`hello` answers before torch is loaded: `device` is null until a `ready` notification brings it (or `problem`, a
sentence, where the environment is broken). A second job while one runs fails with kind "busy". The child ends when its
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
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

from primdiffusion import __version__
from primdiffusion.failures import Failure, describe
from primdiffusion.machine import memory, share_processors
from primdiffusion.serve.draw_params import DrawParams
from primdiffusion.serve.edit_params import InpaintParams, InterpolateParams, TransferParams, VaryParams
from primdiffusion.serve.export_params import GaussiansParams, HumanNpzParams, ProxyParams
from primdiffusion.serve.merge_params import FitGainParams, MergeFramesParams, MergeParams
from primdiffusion.serve.params import AttributesParams, GenerateParams, ReconstructParams, RenderParams
from primdiffusion.serve.rpc import (
    CANCELLED,
    DOMAIN_ERROR,
    INTERNAL_ERROR,
    METHOD_NOT_FOUND,
    MalformedRequest,
    Request,
    RpcError,
    Wire,
    parse_request,
    read_params,
)
from primdiffusion.serve.variation_params import VariationsParams

if TYPE_CHECKING:
    from primdiffusion.serve.jobs import Jobs

PROTOCOL = 1
HEARTBEAT_S = 0.5
JOBS = {
    "generate": GenerateParams,
    "variations": VariationsParams,
    "attributes": AttributesParams,
    "vary": VaryParams,
    "interpolate": InterpolateParams,
    "inpaint": InpaintParams,
    "transfer": TransferParams,
    "reconstruct": ReconstructParams,
    "render": RenderParams,
    "draw": DrawParams,
    "merge": MergeParams,
    "merge_frames": MergeFramesParams,
    "fit_gain": FitGainParams,
    "proxy": ProxyParams,
    "gaussians": GaussiansParams,
    "human_npz": HumanNpzParams,
}
"""Methods of `Jobs`, which run on the main thread one at a time, and their parameters."""
GRACE_S = 3.0
"""After the parent is gone a job has this long to reach its next step and tidy up; then the process ends anyway."""


@dataclasses.dataclass(frozen=True)
class NoParams:
    """Parameters of hello and shutdown."""


@dataclasses.dataclass(frozen=True)
class CancelParams:
    """Parameters of cancel."""

    id: str | int | float


class Cancelled(Exception):
    """Raised inside a job at its next step after a cancel."""


@dataclasses.dataclass
class Job:
    """The request at work."""

    request: Request
    params: Any
    cancelled: threading.Event = dataclasses.field(default_factory=threading.Event)


class Server:
    """One conversation: lines from `source`, messages to `wire`, one job at a time."""

    def __init__(self, source: BinaryIO, wire: Wire):
        self._source = source
        self._wire = wire
        self._queue: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._job: Job | None = None
        self._ended = threading.Event()
        self._state: dict[str, Any] = {"ready": False, "problem": None, "device": None, "device_name": None}
        self._methods: dict[str, Callable[[Request], None]] = {
            "hello": self._hello,
            "cancel": self._cancel,
            "shutdown": self._shutdown,
            **dict.fromkeys(JOBS, self._accept),
        }

    def run(self) -> None:
        """Serves until shutdown, or the end of the input or of the output. Call from the main thread."""
        threading.Thread(target=self._read, name="reader", daemon=True).start()
        threading.Thread(target=self._beat, name="heartbeat", daemon=True).start()
        jobs = self._warm_up()
        while (job := self._queue.get()) is not None:
            self._run_job(jobs, job)

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
            request = parse_request(line)
        except MalformedRequest as e:
            self._wire.fail(e.id, e)
            return
        try:
            method = self._methods.get(request.method)
            if method is None:
                known = ", ".join(self._methods)
                raise RpcError(METHOD_NOT_FOUND, f"there is no method {request.method!r}: the methods are {known}")
            method(request)
        except OSError:
            raise
        except Exception as e:
            self._fail(request, _as_rpc_error(e))

    def _hello(self, request: Request) -> None:
        read_params(NoParams, request.params, "hello")
        about = {"name": "primdiffusion", "version": __version__, "protocol": PROTOCOL, "pid": os.getpid()}
        python = {"python": platform.python_version(), "executable": sys.executable}
        self._respond(request, {**about, **python, **memory(), **self._state})

    def _cancel(self, request: Request) -> None:
        params = read_params(CancelParams, request.params, "cancel")
        with self._lock:  # also while answering, so that the answer comes before the end of the job
            found = self._job is not None and self._job.request.id == params.id
            if found and self._job is not None:
                self._job.cancelled.set()
            self._respond(request, {"cancelled": found})

    def _shutdown(self, request: Request) -> None:
        read_params(NoParams, request.params, "shutdown")
        self._respond(request, {})
        self._end()

    def _accept(self, request: Request) -> None:
        job = Job(request, read_params(JOBS[request.method], request.params, request.method))
        with self._lock:
            if self._job is not None:
                sentence = f"the backend is at work on request {self._job.request.id!r}: one job at a time"
                raise RpcError(DOMAIN_ERROR, sentence, {"kind": "busy", "remedy": "wait for it, or cancel it first"})
            self._job = job
        self._queue.put(job)

    def _end(self) -> None:
        """A job at work may tidy up first; with none there is nothing to wait for, not even torch being loaded."""
        self._ended.set()
        with self._lock:
            if self._job is None:
                _leave(0)
            self._job.cancelled.set()
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

    def _warm_up(self) -> Jobs | RpcError:
        """Imports torch and all that needs it; a broken environment becomes the error of every later job."""
        try:
            from primdiffusion.serve.jobs import Jobs

            jobs = Jobs()
        except Exception as e:
            error = _as_rpc_error(e)
            self._state = {**self._state, "problem": str(error)}
            self._notify("ready", **self._state)
            return error
        self._state = {**self._state, "ready": True, **jobs.device_info()}
        self._notify("ready", **self._state)
        return jobs

    def _run_job(self, jobs: Jobs | RpcError, job: Job) -> None:
        def report(stage: str, step: int, total: int, eta_s: float | None, /, **more: Any) -> None:
            if job.cancelled.is_set():
                raise Cancelled
            self._notify("progress", id=job.request.id, stage=stage, step=step, total=total, eta_s=eta_s, **more)

        try:
            if isinstance(jobs, RpcError):
                raise jobs
            result = getattr(jobs, job.request.method)(job.params, report)
        except Cancelled:
            outcome: Any = RpcError(CANCELLED, "cancelled")
        except Exception as e:
            outcome = _as_rpc_error(e)
        else:
            outcome = result
        with self._lock:
            self._job = None
        if isinstance(outcome, RpcError):
            self._fail(job.request, outcome)
        else:
            self._respond(job.request, outcome)

    # any thread

    def _respond(self, request: Request, result: Any) -> None:
        if request.wants_response:
            self._wire.respond(request.id, result)

    def _fail(self, request: Request, error: RpcError) -> None:
        if request.wants_response:
            self._wire.fail(request.id, error)

    def _notify(self, method: str, **params: Any) -> None:
        self._wire.notify(method, **params)


def _as_rpc_error(error: Exception) -> RpcError:
    """What the other side is told; the traceback goes to stderr, where the client keeps the last lines."""
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
