"""Functions on a CUDA device as graphs: their launches are recorded once, and repeated without Python."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn
from torch.autograd.function import once_differentiable

log = logging.getLogger(__name__)

ENABLED = True
"""Without it everything is launched from Python, by the same kernels and with the same results."""
MOST = 8
"""Recordings that a function keeps, and failures of one after which it is launched from Python for good."""
Result = TypeVar("Result")

Fits = Callable[[list[int]], bool]
_expected: ContextVar[list[tuple[Tensor, Fits]] | None] = ContextVar("expected", default=None)


def usable(device: torch.device) -> bool:
    """Whether functions on a device can be recorded."""
    return ENABLED and device.type == "cuda"


def recording() -> bool:
    """Whether a `Recorded` is recording: nothing may be read from the device."""
    return _expected.get() is not None


def expect(numbers: Tensor, fits: Fits) -> None:
    """While recording: let every repetition compare numbers, int64 [n], that the host cannot wait for now."""
    expected = _expected.get()
    assert expected is not None
    expected.append((numbers, fits))


def copy_all(targets: Sequence[Tensor], sources: Sequence[Tensor]) -> None:
    """Copy tensors of the same shapes, in one launch if they are of one dtype."""
    torch._foreach_copy_(list(targets), list(sources))  # pyright: ignore[reportPrivateImportUsage]


def record(function: Callable[[], Result]) -> tuple[torch.cuda.CUDAGraph, Result]:
    """Record the launches of a function, which do not run, and return its result, which every replay overwrites.

    The function must have run before, so that its kernels are compiled; its inputs must stay where they are. Unlike
    `torch.cuda.graph` it neither waits for the device nor empties the allocator's cache, both of which would cost more
    than most repetitions gain.
    """
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        # Other threads, such as those of data loaders, may allocate memory meanwhile.
        graph.capture_begin(capture_error_mode="thread_local")
        try:
            result = function()
        finally:
            graph.capture_end()
    torch.cuda.current_stream().wait_stream(stream)
    return graph, result


class Reading:
    """A small tensor on its way to the host: `wait` waits for what was launched before, not for what comes after."""

    def __init__(self, numbers: Tensor) -> None:
        self._host, self._done = numbers, None
        if numbers.device.type == "cuda":
            # On a stream of its own: between two kernels the copy would hold up the second one.
            stream = _stream_of_readings(numbers.device)
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                self._host = torch.empty(numbers.shape, dtype=numbers.dtype, pin_memory=True)
                self._host.copy_(numbers, non_blocking=True)
                self._done = stream.record_event()

    def wait(self) -> list[Any]:
        """Return the numbers."""
        if self._done is not None:
            self._done.synchronize()
        return self._host.tolist()


@functools.cache
def _stream_of_readings(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)


class Recorded:
    """A function of tensors on one device that is recorded when it is called with the same shapes for the second time.

    The function must not wait for the device, and `expect` what it cannot check; if a repetition does not meet that,
    the call runs the function again from Python, which can: such a function must change no tensor. Random numbers of
    torch's own generator are those of a call from Python. Results are overwritten by the next call. Gradients can be
    taken inside of the function, not through it. On processors this is the function itself.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]]) -> None:
        self._function = function
        self._recordings: dict[tuple, _Recording] = {}

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Call the function."""
        if not usable(inputs[0].device):
            return self._function(*inputs)
        key = tuple((tensor.shape, tensor.dtype) for tensor in inputs)
        if key not in self._recordings:
            if len(self._recordings) >= MOST:
                self._recordings.pop(next(iter(self._recordings)))
            self._recordings[key] = _Recording(self._function, inputs)
        return self._recordings[key](inputs)


class _Recording:
    """A function for inputs of one shape, which it reads from copies: Triton compiles for how arguments are aligned."""

    def __init__(self, function: Callable[..., tuple[Tensor, ...]], inputs: Sequence[Tensor]) -> None:
        with torch.inference_mode(False):
            self._inputs = [torch.empty_like(tensor) for tensor in inputs]
        self._function, self._failures = function, 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._compiled = False

    def __call__(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        with torch.no_grad():
            copy_all(self._inputs, inputs)
        if self._compiled and self._failures < MOST:
            if self._graph is None:
                self._record()
            if self._graph is not None and self._repeated(self._graph):
                return self._result
            self._graph, self._failures = None, self._failures + 1
        self._compiled = True
        return self._function(*self._inputs)

    def _record(self) -> None:
        token = _expected.set([])
        try:
            with torch.inference_mode(False):
                self._graph, (self._result, self._numbers, self._fits) = record(self._run)
        except (RuntimeError, MemoryError) as error:
            log.warning("launched from Python from now on, because it cannot be recorded: %s", error)
            self._failures = MOST
        finally:
            _expected.reset(token)

    def _run(self) -> tuple[tuple[Tensor, ...], Tensor | None, list[Fits]]:
        result, expected = self._function(*self._inputs), _expected.get() or []
        numbers = torch.stack([numbers for numbers, _ in expected]) if expected else None
        return result, numbers, [fits for _, fits in expected]

    def _repeated(self, graph: torch.cuda.CUDAGraph) -> bool:
        """Whether a repetition has met what the function expects."""
        graph.replay()
        torch.autograd.graph.increment_version(self._result)
        found = [] if self._numbers is None else Reading(self._numbers).wait()
        return all(fits(numbers) for fits, numbers in zip(self._fits, found, strict=True))


class RecordedLoss:
    """A loss of tensors as `Recorded`, together with its gradients in all parameters of a network.

    The result is for one backward pass, before the next call. On processors this is the loss itself, and so it is with
    several processes, which exchange gradients while the backward pass runs.
    """

    def __init__(self, loss: Callable[..., Tensor], network: nn.Module) -> None:
        self._loss, self._parameters = loss, list(network.parameters())
        self._recorded = Recorded(self._with_gradients)

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Return the loss."""
        if not usable(inputs[0].device) or (distributed.is_available() and distributed.is_initialized()):
            return self._loss(*inputs)
        loss, *gradients = self._recorded(*inputs)
        return _Known.apply(loss, gradients, *self._parameters)

    def _with_gradients(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        loss = self._loss(*inputs)
        return loss.detach(), *torch.autograd.grad(loss, self._parameters)


class _Known(torch.autograd.Function):
    """A number whose gradients in further arguments are known."""

    @staticmethod
    def forward(ctx: Any, number: Tensor, gradients: list[Tensor], *_: Tensor) -> Tensor:
        ctx.gradients = gradients
        return number.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, on_number: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return None, None, *torch._foreach_mul(ctx.gradients, on_number)  # pyright: ignore[reportPrivateImportUsage]
