"""What the machine says of itself."""

import dataclasses
import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from primdiffusion import cli
from primdiffusion.diffusion.checkpoint import default_checkpoint, load_checkpoint, save_checkpoint
from primdiffusion.diffusion.codec import WholeSlab
from primdiffusion.diffusion.denoiser import LocalUNetConfig
from primdiffusion.diffusion.model import sample
from primdiffusion.files.regular_files import FileError, check_size
from primdiffusion.runtime.device import (
    GRID_THREADS,
    SLAB_THREADS,
    best_device,
    device_info,
    each_with_fixed_threads,
    fixed_threads,
    has_bfloat16,
    has_fast_bfloat16,
)
from primdiffusion.runtime.machine import choose_device, memory, share_processors
from primdiffusion.runtime.worker_process import THREAD_COUNTS, each, run_in_process
from support.errors import refused
from support.tiny import tiny_model
from thread_bytes import by_threads


def test_memory_and_device_are_stated_in_gigabytes():
    assert 0.1 < memory()["memory_free_gb"] <= memory()["memory_gb"] < 10_000
    assert device_info(torch.device("cpu"))["device"] == "cpu"
    assert best_device().type in ("cpu", "cuda")


def test_waiting_threads_sleep_unless_the_user_wants_otherwise(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    share_processors()
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    share_processors()
    assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE"


@pytest.fixture
def undecided(monkeypatch):
    """Environment variables as they were after the test."""
    for name in ("PRIMDIFFUSION_DEVICE", "PYTORCH_ENABLE_MPS_FALLBACK"):
        monkeypatch.setenv(name, "")


@pytest.mark.usefixtures("undecided")
def test_an_apple_gpu_is_used_where_asked_for_and_lends_the_cpu_what_it_cannot(monkeypatch):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    choose_device("mps")
    assert best_device() == torch.device("mps")
    assert os.environ["PYTORCH_ENABLE_MPS_FALLBACK"] == "1"
    monkeypatch.setattr(torch.mps, "recommended_max_memory", lambda: 12e9)
    monkeypatch.setattr(torch.mps, "driver_allocated_memory", lambda: 2e9)
    assert device_info(best_device())["device_memory_free_gb"] == 10


@pytest.mark.usefixtures("undecided")
@pytest.mark.parametrize(("name", "of"), [("mps", torch.backends.mps), ("cuda", torch.cuda)])
def test_a_device_that_is_not_there_is_one_sentence(name, of, monkeypatch, fails):
    monkeypatch.setattr(of, "is_available", lambda: False)
    for line in (["--device", name, "info"], ["info", f"--device={name}"]):
        failed = fails(*line)
        assert (failed.code, failed.err.count("\n")) == (1, 1)
        assert f"the device {name}" in failed.err


@pytest.mark.usefixtures("undecided")
def test_a_device_by_another_name_is_a_usage_error(capsys, fails):
    for line in (["info", "--device", "tpu"], ["info", "--device"], ["info", "--device", "cpu", "--device=mps"]):
        failed = fails(*line)
        assert failed.code == cli.USAGE
        assert "cpu, cuda, mps" in failed.err
    cli.main(["info", "--device", "cpu"])
    assert '"device": "cpu"' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("capabilities", "has", "fast"),
    [
        ({"avx2": True}, False, False),
        ({"avx512_bf16": True, "amx_bf16": False}, True, False),
        ({"avx512_bf16": True, "amx_bf16": True}, True, True),
        ({"sve_bf16": True}, True, True),
    ],
)
def test_a_processor_is_fast_in_bfloat16_with_matrix_instructions(monkeypatch, capabilities, has, fast):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    device = torch.device("cpu")
    assert (has_bfloat16(device), has_fast_bfloat16(device)) == (has, fast)


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


@pytest.fixture(scope="module")
def model():
    """Its network has the operations whose results depend on the number of threads, and adds to every guess."""
    model = tiny_model(LocalUNetConfig(widths=(64, 128)))
    generator = torch.Generator().manual_seed(0)
    for parameter in model.denoiser.parameters():
        parameter.data.copy_(0.05 * torch.randn(parameter.shape, generator=generator))
    return model


def test_files_are_the_same_on_one_two_and_three_threads(model, tmp_path):
    checkpoint = tmp_path / "small.safetensors"
    save_checkpoint(checkpoint, model, "linear")
    one, two, three = by_threads(checkpoint, tmp_path, 6)
    assert one == two == three


@pytest.mark.slow
def test_files_of_the_default_checkpoint_are_the_same_on_one_two_and_three_threads(tmp_path):
    load_checkpoint(None)
    one, two, three = by_threads(default_checkpoint(), tmp_path, 30)
    assert one == two == three


def test_without_fixed_threads_the_network_of_these_tests_differs(model):
    x, results = torch.randn(1, 4, 32, 32), []
    for threads in (1, 2):
        with fixed_threads(threads):
            results.append(model.denoise(x, 500))
    assert not torch.equal(*results)


def test_the_caller_keeps_its_threads_between_steps_and_after_errors(model):
    with fixed_threads(2):
        for _ in sample(model, [1], 3):
            assert torch.get_num_threads() == 2
        assert torch.get_num_threads() == 2

        def fail():
            assert torch.get_num_threads() == 5
            yield 1
            raise ValueError("a failed step")

        items = each_with_fixed_threads(fail(), 5)
        assert next(items) == 1
        with refused(ValueError, "failed"):
            next(items)
        assert torch.get_num_threads() == 2


def test_networks_over_the_slab_get_more_threads(model):
    assert model.threads == GRID_THREADS
    assert dataclasses.replace(model, codec=WholeSlab()).threads == SLAB_THREADS
