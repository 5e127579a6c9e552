"""Functions run in separate processes."""

import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from primdiffusion.files.regular_files import FileError, check_size
from primdiffusion.runtime.worker_process import THREAD_COUNTS, each, run_in_process
from support.errors import refused


def nothing():
    pass


def test_answers_and_errors_come_back():
    assert run_in_process(math.hypot, 3.0, 4.0, on_wait=nothing) == 5.0
    with refused(ValueError, "domain"):
        run_in_process(math.sqrt, -1.0, on_wait=nothing)
    with refused(FileError, "a.npz") as caught:
        run_in_process(check_size, "a.npz", 2**21, 2**20, on_wait=nothing)
    assert (caught.value.path, caught.value.remedy) == ("a.npz", "use a smaller file")


def test_a_process_that_dies_is_an_error():
    with refused(ValueError, "_exit"):
        run_in_process(os._exit, 3, on_wait=nothing)


def test_what_is_raised_meanwhile_ends_it_at_once():
    def cancel():
        raise InterruptedError

    with pytest.raises(InterruptedError):
        run_in_process(time.sleep, 3600, on_wait=cancel)


def note_threads(path: Path) -> None:
    """In a worker: save its limits of threads."""
    import torch

    counts = [*(os.environ.get(name) for name in THREAD_COUNTS), torch.get_num_threads()]
    path.write_text(" ".join(map(str, counts)))


def test_every_job_is_done_by_workers_of_one_thread(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    paths = [tmp_path / str(number) for number in range(3)]
    assert len(list(each(note_threads, [(path,) for path in paths], workers=2))) == 3
    assert {path.read_text() for path in paths} == {"1 1 1 1 1"}
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_the_first_error_of_a_worker_is_raised(tmp_path):
    with pytest.raises(FileNotFoundError):
        list(each(os.rmdir, [(tmp_path / "none",)] * 3, workers=2))


def test_a_killed_worker_is_an_error_that_says_what_to_do():
    with refused(ValueError, "--workers"):
        list(each(signal.raise_signal, [(signal.SIGKILL,)], workers=2))


def test_one_worker_is_this_process_and_takes_the_next_job_when_asked():
    done = []
    jobs: Iterator[None] = each(done.append, [(1,), (2,)], workers=1)
    next(jobs)
    assert done == [1]
    assert len(list(jobs)) == 1
    assert done == [1, 2]
