"""Functions on a CUDA device as graphs: their launches are recorded once, and repeated without Python."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any, TypeVar

import torch
from torch import Tensor

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

    The function must be pure, must not wait for the device, and `expect` what it cannot check; if a repetition does not
    meet that, the call runs the function from Python, which can. Results are overwritten by the next call. Gradients
    can be taken inside of the function, not through it. On processors this is the function itself.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]]) -> None:
        self._function = function
        self._recordings: dict[tuple, _Recording | None] = {}
        self._failures: dict[tuple, int] = {}

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Call the function."""
        key = tuple((tensor.shape, tensor.dtype) for tensor in inputs)
        if not usable(inputs[0].device) or self._failures.get(key, 0) >= MOST:
            return self._function(*inputs)
        if key not in self._recordings:
            if len(self._recordings) >= MOST:
                self._recordings.pop(next(iter(self._recordings)))
            self._recordings[key] = None
            return self._function(*inputs)
        recording = self._recordings[key]
        if recording is None:
            recording = self._recordings[key] = _Recording(self._function, inputs)
        result = recording.replay(inputs)
        if result is None:
            self._failures[key] = self._failures.get(key, 0) + 1
            self._recordings[key] = None
            return self._function(*inputs)
        return result


class _Recording:
    """The launches of a function for inputs of one shape, copies of which it reads."""

    def __init__(self, function: Callable[..., tuple[Tensor, ...]], inputs: Sequence[Tensor]) -> None:
        with torch.inference_mode(False):
            self._inputs = [tensor.detach().clone() for tensor in inputs]
            # Once more for these copies: kernels are compiled for how their arguments are aligned.
            function(*self._inputs)
            token = _expected.set([])
            try:
                self._graph, (self._result, self._numbers, self._fits) = record(lambda: self._run(function))
            finally:
                _expected.reset(token)

    def _run(self, function: Callable[..., tuple[Tensor, ...]]) -> tuple[tuple[Tensor, ...], Tensor | None, list[Fits]]:
        result, expected = function(*self._inputs), _expected.get() or []
        numbers = torch.stack([numbers for numbers, _ in expected]) if expected else None
        return result, numbers, [fits for _, fits in expected]

    @torch.no_grad()
    def replay(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...] | None:
        """Repeat for these inputs; None if that is not what the function expects."""
        copy_all(self._inputs, inputs)
        self._graph.replay()
        if self._numbers is not None:
            found = Reading(self._numbers).wait()
            if not all(fits(numbers) for fits, numbers in zip(self._fits, found, strict=True)):
                return None
        torch.autograd.graph.increment_version(self._result)
        return self._result
