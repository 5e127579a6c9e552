"""numba with a disk cache that notices a change in any of the kernels' sources."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.dispatcher import Dispatcher

FASTMATH = frozenset({"contract", "arcp", "nsz", "reassoc"})
"""Rounding may differ from the source's; NaN and infinity keep their meaning."""

_njit: Any = numba.njit  # its overloads do not know all options
_SOURCES = ("cpu_*.py", "tiles.py", "lattice.py", "compositing.py")


def compiled(
    *, parallel: bool = False, forceinline: bool = False, allocates: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` with `FASTMATH` and the processor's division, cached on disk.

    `forceinline` puts the function into its callers, whose loops can then be vectorised. A function that neither is
    `parallel` nor `allocates` arrays counts no references: its caller holds them, and the atomic counters would cost
    more than the samples.

    numba 0.68 recompiles a cached kernel when the kernel's own file has changed, but not when a function or a constant
    it takes from another file has. Here the files that hold them are part of the cache's stamp.
    """

    def compile_(function: Callable[..., Any]) -> Dispatcher:
        dispatcher = _njit(
            parallel=parallel,
            forceinline=forceinline,
            _nrt=parallel or allocates,
            fastmath=set(FASTMATH),
            error_model="numpy",
            cache=True,
        )(function)
        dispatcher._cache._cache_file._source_stamp = _stamp()
        return dispatcher

    return compile_


def _stamp() -> tuple[tuple[str, int, int], ...]:
    folder = Path(__file__).parent
    files = sorted(path for pattern in _SOURCES for path in folder.glob(pattern))
    return tuple((path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in files)
