"""Fifty humans in and out of one file, with undo and redo: nothing of them stays in Blender."""

import bpy
import psutil
import pytest
from human_files import remove_human
from jobs_driven import drive

import blender_primdiffusion
from blender_primdiffusion.jobs import follow
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.human import humans

pytestmark = [pytest.mark.slow, pytest.mark.any_blender, pytest.mark.timeout(1800)]
HUMANS, WARM_UP = 50, 10
UNDO_AND_REDO = 4
"""For each human, half of them undo."""
MOST_MB = 1.5
"""By which the process may grow with each human after the first WARM_UP."""
UNDO_STEPS = 8
"""That Blender keeps: more would count as growth until the limit is reached."""


def data_blocks() -> dict[str, int]:
    kinds = (name for name in dir(bpy.data) if isinstance(getattr(bpy.data, name), bpy.types.bpy_prop_collection))
    return {name: len(getattr(bpy.data, name)) for name in kinds}


def handlers() -> list[str]:
    found = []
    for name in dir(bpy.app.handlers):
        functions = getattr(bpy.app.handlers, name)
        if isinstance(functions, list):
            found += [f"{name} {function.__module__}.{function.__qualname__}" for function in functions]
    return found


def one_human(context, seed: int) -> None:
    """Generate a human, undo and redo it, and remove it."""
    queue.add(context, GenerateJob(seed, {"steps": 2}))
    drive()
    for _ in range(UNDO_AND_REDO // 2):
        bpy.ops.ed.undo()
        assert not humans(bpy.context.scene)
        bpy.ops.ed.redo()
        assert len(humans(bpy.context.scene)) == 1
    remove_human(humans(bpy.context.scene)[0])
    bpy.ops.ed.undo_push(message="Remove Human")


def test_fifty_humans_in_and_out_leave_nothing_behind(addon, capsys):
    bpy.context.preferences.edit.undo_steps = UNDO_STEPS
    bpy.ops.ed.undo_push(message="Empty")
    before, process = handlers(), psutil.Process()
    for seed in range(20, 20 + WARM_UP):  # lower seeds are orders to the fake child
        one_human(bpy.context, seed)
    blocks, resident = data_blocks(), process.memory_info().rss
    for seed in range(20 + WARM_UP, 20 + HUMANS):
        one_human(bpy.context, seed)
    growth = (process.memory_info().rss - resident) / 1e6 / (HUMANS - WARM_UP)
    with capsys.disabled():
        print(f"\n{growth:.2f} MB a human")
    assert data_blocks() == blocks
    assert growth < MOST_MB, f"the process grew by {growth:.2f} MB with each human (at most {MOST_MB} MB)"
    assert handlers() == before
    assert not queue.busy
    blender_primdiffusion.unregister()
    try:
        assert not [handler for handler in handlers() if "primdiffusion" in handler]
        timers = (follow.follow, follow.watch)
        assert not any(map(bpy.app.timers.is_registered, timers))
    finally:
        blender_primdiffusion.register()
