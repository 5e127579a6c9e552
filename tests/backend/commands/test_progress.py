"""The time left of a request."""

import pytest
from primdiffusion.commands import progress as module
from primdiffusion.commands.progress import Pace


def paced(monkeypatch, steps: list[float]) -> list[float | None]:
    """Estimates after steps of these seconds."""
    now, pace, found = 0.0, Pace(), []
    for done, step in enumerate(steps, 1):
        now += step
        monkeypatch.setattr(module.time, "perf_counter", lambda now=now: now)
        found.append(pace.left(done, len(steps)))
    return found


def test_the_time_left_leaves_out_loading_and_compiling(monkeypatch):
    steps = [90.0, 4.0, 60.0, 4.0, 5.0, *([4.0] * 25)]  # the marcher is compiled for a preview in the third
    found = paced(monkeypatch, steps)
    assert found[:2] == [None, None]
    for done in range(3, len(steps)):
        assert found[done - 1] == pytest.approx(sum(steps[done:]), rel=0.15)
    assert found[-1] == 0


def test_the_time_left_follows_a_machine_that_becomes_slow(monkeypatch):
    found = paced(monkeypatch, [1.0] * 20 + [10.0] * 20)
    assert found[18] == pytest.approx(21)
    assert found[30] == pytest.approx(90)


def test_a_single_step_leaves_nothing_to_wait_for(monkeypatch):
    assert paced(monkeypatch, [30.0]) == [0]
