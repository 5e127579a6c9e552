"""Run jobs on several processes, which exit with their parent."""

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
    """A worker process was killed."""


def each(work: Callable[..., object], jobs: Iterable[tuple[Any, ...]], workers: int) -> Iterator[None]:
    """Call `work(*job)` for every job, in this process or in `workers` others; yield after each finished job.

    The first error stops it: running jobs are finished, queued ones dropped. So does closing the iterator, and Ctrl-C,
    which only this process receives.

    Raises:
        WorkerKilledError: a process was killed, usually out of memory.
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
                f"one of {workers} worker processes was killed, perhaps out of memory: run the command again with "
                "fewer --workers; finished files are skipped"
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Limit child processes to one numpy and numba thread: there are as many processes as cores."""
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
