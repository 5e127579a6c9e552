"""A cancel in the middle of a step, with the real child: the step is made to hold the interpreter for a minute, so that
the child neither hears the cancel nor beats."""

import os
import sys
import time

import pytest
from child_requests import generate_request, this_pythons_backend
from waiting import BACKEND

from blender_primdiffusion.backend.requests import ChildRequest

TICK_S = 0.1
"""Of Blender's timer."""
LONG_STEPS = """
import ctypes, importlib.util, sys

class LongSteps:
    def find_spec(self, name, path, target=None):
        if name != "primdiffusion.commands.progress":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        execute = spec.loader.exec_module

        def execute_and_lengthen(module):
            execute(module)
            reporter = module.step_reporter

            def long_reporter(*args):
                tell = reporter(*args)
                return lambda step: (tell(step), ctypes.PyDLL(None).sleep(1800))

            module.step_reporter = long_reporter

        spec.loader.exec_module = execute_and_lengthen
        return spec

sys.meta_path.insert(0, LongSteps())
"""


def tick(request: ChildRequest, until, timeout_s: float = 300.0) -> None:
    """As Blender's timer does."""
    end = time.monotonic() + timeout_s
    while not until():
        assert time.monotonic() < end, (request.state, request.message)
        request.tick()
        time.sleep(TICK_S)


@pytest.fixture
def backend(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(LONG_STEPS)
    backend = this_pythons_backend(env={"PYTHONPATH": f"{tmp_path}{os.pathsep}{BACKEND}"})
    yield backend
    backend.shutdown()


@pytest.mark.skipif(sys.platform == "win32", reason="the long step is made by libc")
def test_a_cancel_in_the_middle_of_a_step_does_not_wait_for_the_step_and_leaves_nothing(backend, checkpoint, tmp_path):
    out = tmp_path / "out"
    request = generate_request(backend, seed=4, steps=5, out_dir=out, checkpoint=checkpoint)
    tick(request, lambda: request.step >= 1)
    client = backend.client
    time.sleep(0.3)
    request.cancel()
    tick(request, lambda: request.finished)
    assert request.state == "cancelled"
    assert backend.client is None, "no request uses a child that is about to end"
    assert client.gone_within(300.0)
    end = time.monotonic() + 300.0
    while out.exists():
        backend.reap()  # as the timer does, where killing the child takes longer
        assert time.monotonic() < end, list(out.iterdir())
        time.sleep(0.05)
