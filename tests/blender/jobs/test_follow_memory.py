"""The child's memory is released when it is idle."""

from __future__ import annotations

import os
import time

import bpy
import pytest
from jobs_driven import drive, until_running
from support.fake_child import TAKES_LONG

from blender_primdiffusion.jobs import follow
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


def test_a_busy_child_is_never_idle(addon):
    queue.add(bpy.context, GenerateJob(TAKES_LONG, {"steps": 50}))
    until_running()
    assert not follow.release_when_idle(time.monotonic() + 10_000)


def test_an_idle_child_is_ended_after_ten_minutes_and_the_next_job_starts_another(addon):
    pid, begun = started_and_idle(), queue.idle_since
    assert not follow.release_when_idle(begun + 599)
    assert follow.release_when_idle(begun + 601)
    assert ended(pid)
    assert not follow.release_when_idle(begun + 700), "nothing is left to end"
    assert started_and_idle() not in (pid, None)
    assert len(humans(bpy.context.scene)) == 2
    assert queue.child_message == ""
