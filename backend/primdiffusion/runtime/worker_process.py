"""Worker processes, one thread each, ending with their parent; and a folder that one process holds.

A function may run in a process of its own: igl and xatlas hold the GIL for seconds, in which calls could not be
cancelled and the child would look dead to its parent.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout

from primdiffusion.files.regular_files import check_unlinked

POLL_S = 0.2
Result = TypeVar("Result")


def begin_worker() -> None:
    """Limit torch, which ignores part of the environment, to one thread, and end the process with its parent.

    The workers of a pool would outlive a killed parent and keep computing. Ctrl-C is left to the parent, which lets
    workers finish.
    """
    import torch  # only in the worker

    torch.set_num_threads(1)
    end_with_parent()


def end_with_parent() -> None:
    """End with the parent and ignore Ctrl-C, in a process without torch."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def run_in_process(function: Callable[..., Any], *arguments: Any, on_wait: Callable[[], None]) -> Any:
    """Return `function(*arguments)`, computed in a spawned process; arguments and result are pickled.

    The process imports the function's module, so that module should import quickly. `on_wait` is called every
    POLL_S; an exception it raises kills the process. Raises the function's own exceptions, and ValueError for a
    process that died.
    """
    context = multiprocessing.get_context("spawn")
    answers, answering = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(answering, function, arguments), daemon=True)
    process.start()
    answering.close()
    try:
        while not answers.poll(POLL_S):
            on_wait()
        done, answer = answers.recv()
    except EOFError as e:
        raise ValueError(f"the process of {function.__name__} died, perhaps out of memory: try again") from e
    finally:
        process.kill()
        process.join()
        answers.close()
    if not done:
        raise answer
    return answer


def _answer(answering: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    end_with_parent()
    try:
        answer = True, function(*arguments)
    except Exception as e:
        answer = False, e
    answering.send(answer)


THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def each(work: Callable[..., Result], jobs: Iterable[tuple[Any, ...]], workers: int) -> Iterator[Result]:
    """Yield `work(*job)` of every job as it is finished, in this process or in `workers` others.

    The first error stops it: running jobs are finished, queued ones dropped. So does closing the iterator, and Ctrl-C,
    which only this process receives.

    Raises:
        ValueError: a process was killed, usually out of memory.
        Exception: whatever `work` raises.
    """
    if workers == 1:
        for job in jobs:
            yield work(*job)
        return
    context = multiprocessing.get_context("spawn")
    with _single_threaded_children():
        pool = ProcessPoolExecutor(workers, context, begin_worker)
        try:
            waiting = {pool.submit(work, *job) for job in jobs}
            while waiting:
                finished, waiting = wait(waiting, timeout=1.0, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield future.result()
        except BrokenProcessPool as error:
            raise ValueError(
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


LOCK = ".lock"
"""The lock file in the folder. It stays there: removing it while another process opens it would let two in."""


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Hold a folder, created if need be, for one process at a time. Raises ValueError, OSError.

    The system releases the lock when the process ends, however it ends.
    """
    folder.mkdir(parents=True, exist_ok=True)
    check_unlinked(folder / LOCK)
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(f"another process works in {folder}: wait for it, or give another folder") from None
    except NotImplementedError as e:
        raise ValueError(f"the disk of {folder} has no locks: give a folder on another disk") from e
    try:
        yield
    finally:
        lock.release()
