"""Numba compilation and threading for the CPU marcher, and the list of boxes that each tile sees."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from jaxtyping import Int32, Int64
from llvmlite import ir
from numba import types
from numba.core import config
from numba.extending import intrinsic
from numpy import ndarray

from primdiffusion.files.regular_files import read_regular

FASTMATH = frozenset({"contract", "arcp", "nsz", "reassoc"})
"""Allows different rounding, but keeps the semantics of NaN and infinity."""

THREADS: int = vars(config)["NUMBA_NUM_THREADS"]
"""All processors available to this process, or the value of the environment variable NUMBA_NUM_THREADS."""

_njit: Any = numba.njit  # the type stubs lack some options
_compiled_call: Any = intrinsic  # untyped: callers omit the typing context and pass other types
_LARGEST_SOURCE = 1_000_000
"""Bytes."""
_SOURCES = ("cpu/*.py", "merge.py", "lattice.py", "compositing.py")

Function = Callable[..., Any]
Result = TypeVar("Result")


def kernel(function: Function) -> Any:
    """Compile a kernel for `on_all_threads`, cached on disk.

    numba 0.68 invalidates a cached kernel when its own file changes, but not when functions or constants from other
    files do. Here the cache stamp covers the content of all of those files.
    """
    dispatcher = _njit(nogil=True, cache=True, fastmath=set(FASTMATH), error_model="numpy")(function)
    cache = dispatcher._cache._cache_file
    cache._source_stamp = _stamp()
    cache._load_index = functools.partial(_load_index, cache._load_index)
    return dispatcher


def _load_index(load: Callable[[], dict[Any, Any]]) -> dict[Any, Any]:
    """The kernels that a cache file lists; none if it is of an earlier version and names records that are gone."""
    try:
        return load()
    except (AttributeError, ImportError):
        return {}


def is_compiled(dispatcher: Any) -> bool:
    """Whether a kernel was called or is in the cache, for this processor."""
    if dispatcher.overloads:
        return True
    here = dispatcher.targetctx.codegen().magic_tuple()
    return any(processor == here for _, processor, *_ in dispatcher._cache._cache_file._load_index())


def part(*, inline: bool = False) -> Callable[[Function], Any]:
    """Compile a function that only kernels and other parts call.

    `inline` inlines it, so that loops of the caller can be vectorised. Parts have no reference counting and cannot
    allocate: kernels own all arrays, and atomic counters would cost more than the samples.
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
    """Run the kernel `function(taken, *arguments)` on all threads, which distribute the work with `take`.

    Uses Python threads instead of numba's: numba's OpenMP threads spin while waiting, which can cost more than an image
    on a busy machine and slows down torch, and its built-in pool aborts the process if two threads use it.
    """
    taken = np.zeros(1, np.int64)
    others = [_pool(os.getpid()).submit(function, taken, *arguments) for _ in range(THREADS - 1)]
    function(taken, *arguments)
    for other in others:
        if not other.cancel():  # cancelled if it has not started: no work is left
            other.result()


def at_once(calls: Sequence[Callable[[], Result]]) -> list[Result]:
    """Results of calls of kernels, which run at the same time, on as many threads as there are; in order."""
    others = [_pool(os.getpid()).submit(call) for call in calls[1:]]
    return [calls[0](), *(other.result() for other in others)]


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Thread pool of this process; threads do not survive a fork."""
    return ThreadPoolExecutor(THREADS, thread_name_prefix=f"march-{process}")


@part(inline=True)
def index(i):
    """Convert i in [0, 2^32) to an index without numba's check for negative indices."""
    return np.int64(np.uint32(i))


@_compiled_call
def take(typingctx, taken):
    """Atomically take the next of the numbers 0, 1, 2, ...; `taken`, int64 [1], starts at 0 and counts them.

    Dynamic scheduling lets threads finish together even on a busy machine, and needs one set of buffers per thread.
    """

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(taken), generate


@functools.cache
def _stamp() -> str:
    """Digest of the sources, so that a copy of the package, or an update that leaves them alone, compiles nothing."""
    digest = hashlib.sha256()
    for path in sorted(path for pattern in _SOURCES for path in Path(__file__).parents[1].glob(pattern)):
        digest.update(read_regular(path, _LARGEST_SOURCE))
    return digest.hexdigest()


TILE = 8
"""Width and height of a tile, pixels."""
NEAR = 1e-6
"""Depth at which boxes are clipped, metres along the optical axis."""
MARGIN = 0.01
"""Pixels added around a box's rectangle for rounding."""
NOTHING = (0, -1, 0, -1)


def tiles_across(pixels: int) -> int:
    """Number of tiles in a row or column of `pixels` pixels."""
    return -(-pixels // TILE)


def row_lists(
    rectangle: Int32[ndarray, "k 4"], down: int
) -> tuple[Int64[ndarray, "down+1"], Int32[ndarray, "entries"]]:
    """Lists of the boxes that overlap each row of tiles: `boxes[start[i] : start[i + 1]]`, in order, for row i.

    One list per row instead of per tile, so memory is at most proportional to boxes x rows.
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
    """Number of boxes that each tile sees, row by row; an estimate of its work."""
    seen = rectangle[(rectangle[:, 0] <= rectangle[:, 1]) & (rectangle[:, 2] <= rectangle[:, 3])]
    change = np.zeros((down + 1, across + 1), np.int64)
    np.add.at(change, (seen[:, 2], seen[:, 0]), 1)
    np.add.at(change, (seen[:, 3] + 1, seen[:, 1] + 1), 1)
    np.add.at(change, (seen[:, 3] + 1, seen[:, 0]), -1)
    np.add.at(change, (seen[:, 2], seen[:, 1] + 1), -1)
    return change.cumsum(0).cumsum(1)[:down, :across].ravel()


@part()
def tile_rectangle(corners, across, down):
    """First and last tile column, and first and last tile row, of a box with homogeneous pixel `corners` [8, 3].

    Corner 4 i + 2 j + k is at the low (0) or high (1) end of the box's axes. Boxes are clipped at NEAR. last < first if
    the box is not visible.
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
