"""One person after another on several processes, which end with the one that gives them work."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from primdiffusion.worker_process import begin_worker

THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class WorkerKilledError(ValueError):
    """A process of ours was ended from outside."""


def each(work: Callable[..., object], jobs: Iterable[tuple[Any, ...]], workers: int) -> Iterator[None]:
    """Calls `work(*job)` for every job, on this process or on `workers` others; yields after each that is done.

    The first error ends it: jobs that have begun are finished, others are not begun. So does closing the iterator, or
    Ctrl-C, which reaches this process alone.

    Raises:
        WorkerKilledError: a process was killed, most often because memory ran out.
        Exception: whatever `work` raises.
    """
    if workers == 1:
        for job in jobs:
            work(*job)
            yield
        return
    context = multiprocessing.get_context("spawn")
    with _single_threaded_children():
        pool = ProcessPoolExecutor(workers, context, begin_worker)
        try:
            waiting = {pool.submit(work, *job) for job in jobs}
            while waiting:
                finished, waiting = wait(waiting, timeout=1.0, return_when=FIRST_COMPLETED)
                for future in finished:
                    future.result()
                    yield
        except BrokenProcessPool as error:
            raise WorkerKilledError(
                f"One of {workers} worker processes was killed, perhaps because memory ran out; run the same command "
                "again with fewer --workers: what is finished is kept."
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Processes started meanwhile keep numpy and numba to one thread: there are as many processes as cores."""
    before = {name: os.environ.get(name) for name in THREAD_COUNTS}
    os.environ.update(dict.fromkeys(THREAD_COUNTS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
