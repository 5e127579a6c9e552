"""The GPU is made ready in steps, by the marcher that this Blender has or the reason why it has none."""

from __future__ import annotations

from blender_primdiffusion.engine.gpu import start as module
from blender_primdiffusion.engine.gpu.start import GpuStart


def steps_of(start: GpuStart) -> int:
    """How many steps it takes."""
    assert start.marcher() is None
    steps = 1
    while not start.advance():
        steps += 1
        assert start.working
    assert not start.working
    return steps


def test_the_marcher_is_ready_after_some_steps(marcher, monkeypatch):
    monkeypatch.setattr(module, "gpu_marcher", lambda: marcher)
    start = GpuStart()
    assert steps_of(start) > 1
    assert start.marcher() is marcher
    assert not start.fault


def test_why_there_is_no_marcher_is_kept(monkeypatch):
    fault = "this GPU has no float textures"
    monkeypatch.setattr(module, "gpu_marcher", lambda: fault)
    start = GpuStart()
    assert steps_of(start) == 1
    assert start.fault == fault
    assert start.marcher() is None
    assert not start.advance()
