"""Memory of the child process and of Blender: what is shown, released and when."""

from __future__ import annotations

import os
import time
from types import SimpleNamespace

import bpy
import pytest
from jobs_driven import drive, until_running
from support.errors import refused
from support.fake_child import TAKES_LONG

from blender_primdiffusion.jobs import memory
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.human import humans

pytestmark = pytest.mark.any_blender
ops = bpy.ops.primdiffusion


def started_and_idle() -> int:
    """The process id of a child that has made a person."""
    queue.add(bpy.context, GenerateJob(7, {"steps": 1}))
    drive()
    return queue.child_pid


def ended(pid: int, seconds: float = 300.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        queue.listen()  # as a timer does
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False


def test_release_ends_the_child_and_the_next_job_starts_another(addon):
    pid = started_and_idle()
    assert ops.cancel(what="MEMORY") == {"FINISHED"}
    assert ended(pid)
    assert ops.cancel(what="MEMORY") == {"FINISHED"}, "without a child too"
    assert started_and_idle() not in (pid, None)
    assert len(humans(bpy.context.scene)) == 2
    assert queue.child_message == ""


def test_memory_is_not_released_while_the_child_is_busy(addon):
    queue.add(bpy.context, GenerateJob(TAKES_LONG, {"steps": 50}))
    until_running()
    with refused(RuntimeError, "backend"):
        ops.cancel(what="MEMORY")
    assert queue.busy


def test_an_idle_child_is_ended_after_the_minutes_of_the_preferences(addon, monkeypatch):
    pid = started_and_idle()
    begun = queue.idle_since
    assert memory.idle_minutes() == 10.0
    assert not memory.release_when_idle(begun + 599)
    monkeypatch.setattr(memory, "idle_minutes", lambda: 0.0)
    assert not memory.release_when_idle(begun + 10_000)
    monkeypatch.setattr(memory, "idle_minutes", lambda: 10.0)
    assert memory.release_when_idle(begun + 601)
    assert ended(pid)
    assert not memory.release_when_idle(begun + 700), "nothing is left to end"


@pytest.mark.parametrize("renders", [False, True])
def test_grids_are_given_back_with_an_idle_child_but_not_under_a_render(addon, monkeypatch, renders):
    started_and_idle()
    freed = []
    monkeypatch.setattr(memory, "free_unused_grids", lambda: freed.append(1))
    monkeypatch.setattr(memory, "idle_minutes", lambda: 10.0)
    monkeypatch.setattr(memory, "bpy", SimpleNamespace(app=SimpleNamespace(is_job_running=lambda _: renders)))
    assert memory.release_when_idle(queue.idle_since + 601)
    assert len(freed) == (0 if renders else 1)


def test_a_busy_child_is_never_idle(addon):
    queue.add(bpy.context, GenerateJob(TAKES_LONG, {"steps": 50}))
    until_running()
    assert not memory.release_when_idle(time.monotonic() + 10_000)


def test_the_device_line_shows_what_is_known(addon):
    assert memory.device_line() == "starts with the first human"
    queue.info = {"device_name": "H200", "device_memory_gb": 139.8, "device_memory_free_gb": 120.04}
    assert memory.device_line() == "H200, 139.8 GB, 120.0 GB free at its start"
    queue.info = {"device_name": "CPU", "device_memory_gb": None, "memory_gb": 16.0, "memory_free_gb": None}
    assert memory.device_line() == "CPU, 16.0 GB"
    queue.info = {"device_name": "CPU"}
    assert memory.device_line() == "CPU"
