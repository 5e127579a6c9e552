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
from jaxtyping import Int32, Int64
from llvmlite import ir
from numba import types
from numba.core import config
from numba.extending import intrinsic
from numpy import ndarray

FASTMATH = frozenset({"contract", "arcp", "nsz", "reassoc"})
"""Rounding may differ from the source's; NaN and infinity keep their meaning."""

THREADS: int = vars(config)["NUMBA_NUM_THREADS"]
"""All that this process may run on, or as many as the environment variable of that name says."""

_njit: Any = numba.njit  # its overloads do not know all options
_compiled_call: Any = intrinsic  # its callers do not give the typing context, nor see the real types
_SOURCES = ("cpu_*.py", "merge.py", "lattice.py", "compositing.py")

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


TILE = 8
"""Pixels along a side of a tile."""
NEAR = 1e-6
"""Metres along the optical axis: boxes are cut off here, as what lies behind the camera has no place in the picture."""
MARGIN = 0.01
"""Pixels added around a box's rectangle against rounding."""
NOTHING = (0, -1, 0, -1)


def tiles_across(pixels: int) -> int:
    """Tiles in a row or column of so many pixels."""
    return -(-pixels // TILE)


def row_lists(
    rectangle: Int32[ndarray, "k 4"], down: int
) -> tuple[Int64[ndarray, "down+1"], Int32[ndarray, "entries"]]:
    """The boxes that reach into row i of tiles are the second array from the first one's [i] to [i + 1], in order.

    Lists per row and not per tile: memory grows with boxes x rows at worst.
    """
    first, last = rectangle[:, 2].astype(np.int64), rectangle[:, 3].astype(np.int64)
    count = np.maximum(last - first + 1, 0)
    box = np.repeat(np.arange(len(rectangle), dtype=np.int32), count)
    row = np.arange(len(box)) - np.repeat(np.cumsum(count) - count - first, count)
    order = np.argsort(row.astype(np.int16 if down < 2**15 else np.int64), kind="stable")
    start = np.zeros(down + 1, np.int64)
    np.cumsum(np.bincount(row, minlength=down), out=start[1:])
    return start, box[order]


def boxes_per_tile(rectangle: Int32[ndarray, "k 4"], across: int, down: int) -> Int64[ndarray, "tiles"]:
    """How many boxes each tile can see, row by row: an estimate of its work."""
    seen = rectangle[(rectangle[:, 0] <= rectangle[:, 1]) & (rectangle[:, 2] <= rectangle[:, 3])]
    change = np.zeros((down + 1, across + 1), np.int64)
    np.add.at(change, (seen[:, 2], seen[:, 0]), 1)
    np.add.at(change, (seen[:, 3] + 1, seen[:, 1] + 1), 1)
    np.add.at(change, (seen[:, 3] + 1, seen[:, 0]), -1)
    np.add.at(change, (seen[:, 2], seen[:, 1] + 1), -1)
    return change.cumsum(0).cumsum(1)[:down, :across].ravel()


@part()
def tile_rectangle(corners, across, down):
    """First and last tile column, first and last tile row around a box with the homogeneous pixel `corners` [8, 3].

    Corner 4 i + 2 j + k lies at the low or high end of the box's three axes as i, j, k are 0 or 1. What reaches behind
    the camera is cut off at NEAR first. last < first where nothing is in the picture.
    """
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for i in range(8):
        if corners[i, 2] >= NEAR:
            u, v = corners[i, 0] / corners[i, 2], corners[i, 1] / corners[i, 2]
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
        for axis in range(3):
            other = i | (1 << axis)
            if (corners[i, 2] < NEAR) != (corners[other, 2] < NEAR):
                share = (NEAR - corners[i, 2]) / (corners[other, 2] - corners[i, 2])
                u = (corners[i, 0] + share * (corners[other, 0] - corners[i, 0])) / NEAR
                v = (corners[i, 1] + share * (corners[other, 1] - corners[i, 1])) / NEAR
                left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    first_column, last_column = np.ceil(left - MARGIN - 0.5), np.floor(right + MARGIN - 0.5)
    first_row, last_row = np.ceil(top - MARGIN - 0.5), np.floor(bottom + MARGIN - 0.5)
    first_column, last_column = max(first_column, 0.0), min(last_column, across * TILE - 1.0)
    first_row, last_row = max(first_row, 0.0), min(last_row, down * TILE - 1.0)
    if not (first_column <= last_column and first_row <= last_row):
        return NOTHING
    columns = np.int64(first_column) // TILE, np.int64(last_column) // TILE
    return columns[0], columns[1], np.int64(first_row) // TILE, np.int64(last_row) // TILE
