"""The torch device that networks run on, and the number of threads that they take there.

It is the same number on every machine, so that a seed gives the same bytes on any number of cores: torch, oneDNN and
MKL cut an operation into one piece for each thread. The cuts decide in which order terms are added (group
normalisation, 1 x 1 convolutions) and which elements fall outside full vectors (SiLU), so the last bits depend on the
number of threads, and thirty steps of denoising make 1e-4 of that. Replacing the operations that differ would hold for
one processor and one version of the libraries. Threads, however, need no cores of their own: the same number of them
makes the same cuts everywhere, and a machine with fewer cores runs them in turn.

Not covered: environments in which OpenMP starts fewer threads than requested (OMP_THREAD_LIMIT, OMP_DYNAMIC).
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterator
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import torch

from primdiffusion.runtime.machine import CHOSEN_DEVICE, GB

GRID_THREADS = 4
"""For networks over the 32 x 32 grid. Two cores lose about 4 % to it with the default network."""
SLAB_THREADS = 16
"""For networks over the whole slab, whose operations take a thousand times longer."""

T = TypeVar("T")
P = ParamSpec("P")


def best_device() -> torch.device:
    """Return the chosen device, or else CUDA if available, otherwise the CPU.

    Raises ValueError if this machine does not have the chosen device.
    """
    name = os.environ.get(CHOSEN_DEVICE) or ("cuda" if torch.cuda.is_available() else "cpu")
    if name == "mps" and not torch.backends.mps.is_available():
        raise ValueError(
            "the device mps, an Apple GPU, is not available: it needs macOS 14 on Apple silicon and a torch built for "
            "it; choose cpu"
        )
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            "the device cuda is not available: it needs an NVIDIA GPU, its driver and a torch built for CUDA; "
            "choose cpu"
        )
    return torch.device(name)


def has_fast_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 faster than float32.

    A processor takes half as long again with AVX-512's instructions alone, and three times as long without any; the
    latter is assumed with torch before 2.8, which tells nothing. Graphics cards always count as faster.
    """
    return device.type != "cpu" or _has_instructions("amx_bf16", "bf16", "sve_bf16")


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device has instructions that multiply bfloat16, fast or not."""
    return has_fast_bfloat16(device) or _has_instructions("avx512_bf16")


def _has_instructions(*names: str) -> bool:
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in names)


def device_info(device: torch.device) -> dict[str, Any]:
    """Name and memory of the device, for `hello` and the panel; None for the CPU's memory."""
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        return {
            "device": str(device),
            "device_name": torch.cuda.get_device_name(device),
            "device_memory_gb": round(total / GB, 2),
            "device_memory_free_gb": round(free / GB, 2),
        }
    if device.type == "mps":
        total, used = torch.mps.recommended_max_memory(), torch.mps.driver_allocated_memory()
        return {
            "device": str(device),
            "device_name": "Apple GPU",
            "device_memory_gb": round(total / GB, 2),
            "device_memory_free_gb": round((total - used) / GB, 2),
        }
    threads = torch.get_num_threads()
    name = f"CPU, {threads} {'thread' if threads == 1 else 'threads'}"
    return {"device": str(device), "device_name": name, "device_memory_gb": None, "device_memory_free_gb": None}


class ComputesOnThreads(Protocol):
    """A model that names its number of threads."""

    @property
    def threads(self) -> int:
        """Threads of every computation with it."""
        ...


Model = TypeVar("Model", bound=ComputesOnThreads)


@contextlib.contextmanager
def fixed_threads(count: int) -> Iterator[None]:
    """Let torch use `count` threads in the block, or in the decorated function; afterwards the caller's number again.

    Applies to the calling thread, and to Python threads that first use torch within it.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def each_with_fixed_threads(items: Iterator[T], count: int) -> Iterator[T]:
    """Compute each item with `count` threads; what the caller does between them has the caller's number."""
    while True:
        with fixed_threads(count):
            try:
                item = next(items)
            except StopIteration:
                return
        yield item


def on_fixed_threads(function: Callable[Concatenate[Model, P], T]) -> Callable[Concatenate[Model, P], T]:
    """Decorate a function of a model to compute with the model's number of threads."""

    @functools.wraps(function)
    def decorated(model: Model, *args: P.args, **kwargs: P.kwargs) -> T:
        with fixed_threads(model.threads):
            return function(model, *args, **kwargs)

    return decorated
