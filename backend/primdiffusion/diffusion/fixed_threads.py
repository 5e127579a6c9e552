"""The same number of threads on every machine, so that a seed gives the same bytes on any number of cores.

torch, oneDNN and MKL cut an operation into one piece for each thread. The cuts decide in which order terms are added
(group normalisation, 1 x 1 convolutions) and which elements fall outside full vectors (SiLU), so the last bits depend
on the number of threads, and thirty steps of denoising make 1e-4 of that. Replacing the operations that differ would
hold for one processor and one version of the libraries. Threads, however, need no cores of their own: the same number
of them makes the same cuts everywhere, and a machine with fewer cores runs them in turn.

Not covered: environments in which OpenMP starts fewer threads than requested (OMP_THREAD_LIMIT, OMP_DYNAMIC).
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Concatenate, ParamSpec, Protocol, TypeVar

import torch

GRID_THREADS = 4
"""For networks over the 32 x 32 grid. Two cores lose about 4 % to it with the default network."""
SLAB_THREADS = 16
"""For networks over the whole slab, whose operations take a thousand times longer."""

T = TypeVar("T")
P = ParamSpec("P")


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
