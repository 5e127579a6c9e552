"""A generation as the panel follows it, with the real child."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest
from child_jobs import generate_job, this_pythons_backend
from conversation import BUSY_STEPS
from worker.backend import Backend
from worker.client import BackendClient
from worker.environment import BackendNotFound
from worker.job import Request

PYTHON = Path(sys.executable)


def follow(job: Request, until=lambda job: job.finished, timeout_s: float = 60) -> list[str]:
    """Ticks as Blender's timer does; returns the states passed through."""
    states = [job.state]
    end = time.monotonic() + timeout_s
    while not until(job):
        assert time.monotonic() < end, (job.state, job.message)
        job.tick()
        if job.state != states[-1]:
            states.append(job.state)
        time.sleep(0.01)
    return states


@pytest.fixture(scope="module")
def backend():
    backend = this_pythons_backend()
    yield backend
    backend.shutdown()


@pytest.fixture
def start(backend, checkpoint, tmp_path):
    def start(steps: int, name: str = "out", **settings) -> Request:
        return generate_job(
            backend, seed=4, steps=steps, out_dir=tmp_path / name, **{"checkpoint": checkpoint, **settings}
        )

    return start


def test_a_job_runs_from_a_cold_start_to_its_files(start):
    job = start(200)
    assert (job.state, job.fraction, job.message) == ("starting", 0.0, "Starting the backend")
    etas = []
    states = follow(job, lambda job: etas.append(job.eta_s) or job.finished)
    assert states == ["starting", "running", "done"]
    assert job.step == job.total == 200
    assert job.fraction == 1.0
    assert job.error is None
    assert Path(job.result["human"]).exists()
    assert any(eta is not None and eta > 0 for eta in etas)
    assert job.info["device"] in ("cpu", "cuda")
    assert not job.tick(), "a finished job stays as it is"


def test_a_child_that_was_being_started_when_all_was_shut_down_is_ended_too(checkpoint, tmp_path):
    clients = []

    def slowly():
        for _ in range(3):
            yield
        clients.append(BackendClient(PYTHON))
        return clients[0]

    backend = Backend(slowly)
    job = generate_job(backend, seed=1, steps=1, out_dir=tmp_path / "out", checkpoint=checkpoint)
    job.tick()
    backend.shutdown()
    assert follow(job)[-1] == "failed"
    assert not clients[0].alive


def test_a_second_job_uses_the_same_child(start, backend):
    first = backend.connect()
    follow(start(1))
    assert backend.connect() is first


def test_a_cancelled_job_leaves_nothing(start, tmp_path):
    job = start(BUSY_STEPS)
    follow(job, lambda job: job.step > 2)
    job.cancel()
    assert job.state == "cancelling"
    assert follow(job) == ["cancelling", "cancelled"]
    assert job.step < job.total
    assert not (tmp_path / "out").exists()
    assert job.result is None


def test_a_job_cancelled_before_the_child_is_up_is_cancelled(checkpoint, tmp_path):
    backend = this_pythons_backend()
    job = generate_job(backend, seed=1, steps=1, out_dir=tmp_path / "out", checkpoint=checkpoint)
    job.cancel()
    assert follow(job) == ["cancelling", "cancelled"]
    backend.shutdown()


def test_the_second_of_two_clicks_is_refused_with_a_sentence_and_the_first_goes_on(start):
    first, second = start(3), start(3, "second")
    assert second.state == "failed"
    assert second.error.kind == "busy"
    assert str(second.error) == "The backend is at work already. Wait for it, or cancel it first."
    assert follow(first)[-1] == "done"


def test_a_killed_child_fails_the_job_leaves_nothing_and_the_next_job_works(start, tmp_path):
    job = start(BUSY_STEPS)
    follow(job, lambda job: job.step > 2)
    assert list((tmp_path / "out").iterdir()), "the child keeps half-written files here"
    os.kill(job._client.pid, signal.SIGKILL)
    assert follow(job)[-1] == "failed"
    assert job.error.kind == "died"
    assert "killed" in job.error.message
    assert not (tmp_path / "out").exists()
    assert follow(start(1))[-1] == "done"


@pytest.mark.parametrize(
    ("settings", "kind", "named"),
    [
        ({"checkpoint": Path("nowhere.safetensors")}, "missing_file", "nowhere.safetensors"),
        ({"sampler": "magic"}, "bad_input", "magic"),
        ({"steps": 0}, "", "0 steps"),
    ],
)
def test_a_refusal_of_the_backend_becomes_the_jobs_error(start, settings, kind, named):
    job = start(**{"steps": 1, **settings})
    assert follow(job)[-1] == "failed"
    assert job.error.kind == kind
    assert named in job.error.message
    assert job.message == str(job.error)


def test_a_missing_python_is_the_jobs_error(tmp_path):
    def nowhere():
        raise BackendNotFound("No Python for the backend: name one in the preferences.")

    job = generate_job(Backend(nowhere), seed=1, steps=1, out_dir=tmp_path / "out")
    assert follow(job) == ["starting", "failed"]
    assert job.error.kind == "environment"
    assert str(job.error) == "No Python for the backend: name one in the preferences."


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="needs SIGSTOP to hang a process")
def test_a_child_that_hangs_is_ended_and_fails_the_job(checkpoint, tmp_path):
    backend = this_pythons_backend(silence_s=5.0)
    job = generate_job(backend, seed=1, steps=BUSY_STEPS, out_dir=tmp_path / "out", checkpoint=checkpoint)
    follow(job, lambda job: job.step > 2)
    os.kill(job._client.pid, signal.SIGSTOP)
    assert follow(job)[-1] == "failed"
    assert job.error.kind == "hung"
    assert backend.client is None
    assert not (tmp_path / "out").exists()


def test_a_cancel_while_torch_is_loaded_keeps_the_child(checkpoint, tmp_path):
    backend = this_pythons_backend()
    job = generate_job(backend, seed=1, steps=1, out_dir=tmp_path / "out", checkpoint=checkpoint)
    follow(job, lambda job: job._request is not None)
    assert not job.info.get("ready")
    job.cancel()
    assert follow(job)[-1] == "cancelled"
    first = backend.connect()
    again = generate_job(backend, seed=1, steps=1, out_dir=tmp_path / "again", checkpoint=checkpoint)
    assert follow(again)[-1] == "done"
    assert backend.connect() is first
    backend.shutdown()
