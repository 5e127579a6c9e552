"""A generation as the panel follows it, with the real child."""

import os
import signal
import time
from pathlib import Path

import pytest
from child_requests import generate_request, this_pythons_backend
from conversation import BUSY_STEPS

from blender_primdiffusion.backend.client import BackendClient
from blender_primdiffusion.backend.environment import BackendNotFound
from blender_primdiffusion.backend.requests import Backend, ChildRequest


def follow(request: ChildRequest, until=lambda request: request.finished, timeout_s: float = 300) -> list[str]:
    """Ticks as Blender's timer does; returns the states passed through."""
    states = [request.state]
    end = time.monotonic() + timeout_s
    while not until(request):
        assert time.monotonic() < end, (request.state, request.message)
        request.tick()
        if request.state != states[-1]:
            states.append(request.state)
        time.sleep(0.01)
    return states


@pytest.fixture(scope="module")
def backend():
    backend = this_pythons_backend()
    yield backend
    backend.shutdown()


@pytest.fixture
def start(backend, checkpoint, tmp_path):
    def start(steps: int, name: str = "out", **settings) -> ChildRequest:
        return generate_request(
            backend, seed=4, steps=steps, out_dir=tmp_path / name, **{"checkpoint": checkpoint, **settings}
        )

    return start


def test_a_request_runs_from_a_cold_start_to_its_files(start):
    request = start(20)
    assert (request.state, request.fraction, request.message) == ("starting", 0.0, "Starting the backend")
    etas = []
    states = follow(request, lambda request: etas.append(request.eta_s) or request.finished)
    assert states == ["starting", "running", "done"]
    assert request.step == request.total == 20
    assert request.fraction == 1.0
    assert request.error is None
    assert request.result.person.exists()
    assert any(eta is not None and eta > 0 for eta in etas)
    assert request.info["device"] in ("cpu", "cuda")
    assert not request.tick(), "a finished request stays as it is"


@pytest.mark.parametrize(
    ("settings", "kind", "named"),
    [
        ({"checkpoint": Path("nowhere.safetensors")}, "missing_file", "nowhere.safetensors"),
        ({"sampler": "magic"}, "", "magic"),
        ({"steps": 0}, "", "steps is 0"),
    ],
)
def test_an_error_of_the_backend_becomes_the_requests_error(start, settings, kind, named):
    request = start(**{"steps": 1, **settings})
    assert follow(request)[-1] == "failed"
    assert request.error.kind == kind
    assert named in request.error.message
    assert request.message == str(request.error)


@pytest.mark.unix
@pytest.mark.parametrize(("sent", "kind"), [("SIGKILL", "died"), ("SIGSTOP", "hung")])
def test_a_child_that_is_killed_or_hangs_fails_the_request_and_leaves_nothing(
    backend, start, slow_checkpoint, tmp_path, sent, kind
):
    request = start(BUSY_STEPS, checkpoint=slow_checkpoint)
    follow(request, lambda request: request.step > 2)
    assert list((tmp_path / "out").iterdir()), "the child keeps half-written files here"
    os.kill(request._client.pid, getattr(signal, sent))
    request._client._silence_s = 2.0
    assert follow(request)[-1] == "failed"
    assert request.error.kind == kind
    assert kind == "hung" or "killed" in request.error.message
    assert backend.client is None
    follow(request, lambda _: backend.reap() or not (tmp_path / "out").exists())  # once the child has gone


def test_a_cancel_while_torch_is_loaded_keeps_the_child(backend, start):
    backend.release()
    request = start(1)
    follow(request, lambda request: request._id is not None)
    assert not request.info.get("ready")
    request.cancel()
    assert follow(request)[-1] == "cancelled"
    first = backend.client
    assert follow(start(1, "again"))[-1] == "done"
    assert backend.client is first is not None


def script(path: Path, text: str) -> Path:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def nowhere(_folder: Path) -> BackendClient:
    raise BackendNotFound("No Python for the backend: name one in the preferences.")


@pytest.mark.parametrize(
    ("python", "reasons"),
    [
        (nowhere, ["No Python for the backend: name one in the preferences."]),
        (lambda folder: script(folder / "python", "echo \"No module named 'primdiffusion'\" >&2; exit 1"),
         ["cannot run the backend: ", "No module named 'primdiffusion'", "Name a Python 3.11"]),
        (lambda folder: script(folder / "python", "echo hello"),
         ["cannot run the backend: ", "hello", "Name a Python 3.11"]),
        (lambda folder: folder / "no-python", ["Name a Python 3.11"]),
        (lambda folder: folder, ["Name a Python 3.11"]),
    ],
    ids=["none", "without the backend", "talks", "missing", "a folder"],
)  # fmt: skip
def test_a_python_that_does_not_run_the_backend_is_named_with_what_to_do(tmp_path, python, reasons):
    backend = Backend(lambda: BackendClient(python(tmp_path)))
    request = generate_request(backend, seed=1, steps=1, out_dir=tmp_path / "out")
    assert follow(request)[-1] == "failed"
    assert request.error.kind == "environment"
    assert all(reason in str(request.error) for reason in reasons)
    assert python is nowhere or str(tmp_path) in str(request.error)
