"""numba's compiler as the CPU marcher uses it: kernels, which threads run, and the parts they are made of."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import config
from numba.extending import intrinsic

FASTMATH = frozenset({"contract", "arcp", "nsz", "reassoc"})
"""Rounding may differ from the source's; NaN and infinity keep their meaning."""

THREADS: int = vars(config)["NUMBA_NUM_THREADS"]
"""All that this process may run on, or as many as the environment variable of that name says."""

_njit: Any = numba.njit  # its overloads do not know all options
_compiled_call: Any = intrinsic  # its callers do not give the typing context, nor see the real types
_SOURCES = ("cpu_*.py", "tiles.py", "lattice.py", "compositing.py")

Function = Callable[..., Any]


def kernel(function: Function) -> Any:
    """Compiled for `on_all_threads` to call, and cached on disk.

    numba 0.68 compiles a cached kernel again when the kernel's own file has changed, but not when a function or a
    constant it takes from another file has. Here the files that hold them are part of the cache's stamp.
    """
    dispatcher = _njit(nogil=True, cache=True, fastmath=set(FASTMATH), error_model="numpy")(function)
    dispatcher._cache._cache_file._source_stamp = _stamp()
    return dispatcher


def part(*, inline: bool = False) -> Callable[[Function], Any]:
    """Compiled for kernels and other parts to call, not for Python.

    `inline` puts the function into its callers, whose loops can then be vectorised. Parts count no references and so
    cannot allocate: their kernel holds all arrays, and the atomic counters would cost more than the samples.
    """
    return _njit(
        forceinline=inline,
        _nrt=False,
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        fastmath=set(FASTMATH),
        error_model="numpy",
    )


def on_all_threads(function: Any, *arguments: Any) -> None:
    """Calls the kernel `function(taken, *arguments)` on all threads at once, which share the work by `take`.

    These are Python's threads and not numba's: its OpenMP threads wait by spinning, which on a busy machine costs more
    than a picture and takes the processors from torch's; and its own built-in pool ends the process when two threads
    use it at once.
    """
    taken = np.zeros(1, np.int64)
    others = [_pool(os.getpid()).submit(function, taken, *arguments) for _ in range(THREADS - 1)]
    function(taken, *arguments)
    for other in others:
        if not other.cancel():  # one that has not begun has nothing left to do
            other.result()


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Threads of this process: those of the one it was forked from are not there."""
    return ThreadPoolExecutor(THREADS, thread_name_prefix=f"march-{process}")


@part(inline=True)
def index(i):
    """i, which is not negative and below 2^32: numba looks before each use of an index whether it is negative."""
    return np.int64(np.uint32(i))


@_compiled_call
def take(typingctx, taken):
    """The first of the numbers 0, 1, 2, ... that no thread has taken yet; `taken` int64 [1], at first 0, counts them.

    Threads that take their work piece by piece finish together, which shares fixed beforehand do not, least of all on
    a busy machine; and what a thread needs to work with is allocated once a thread and not once a piece.
    """

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(taken), generate


def _stamp() -> tuple[tuple[str, int, int], ...]:
    folder = Path(__file__).parent
    files = sorted(path for pattern in _SOURCES for path in folder.glob(pattern))
    return tuple((path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in files)
