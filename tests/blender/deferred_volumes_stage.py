"""A human whose volumes are deferred: made, written by halves, and whole."""

from __future__ import annotations

from pathlib import Path

import bpy
from blender_primdiffusion.jobs.deferred_volumes import deferred_volumes
from blender_primdiffusion.scene.pending import pending_of
from human_files import paths_of
from jobs_driven import drive

from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.scene.payload import session_folder

COUNT = 12
"""Primitives of the synthetic person."""
STATES = ("absent", "half", "written")


def generated(seed: int = 7) -> bpy.types.Object:
    queue.add(bpy.context, GenerateJob(seed, {"steps": 1}))
    drive()
    return humans(bpy.context.scene)[-1]


def advance(state_wanted: str) -> None:
    """Write no volumes, about half of them, or all."""
    if state_wanted == "half":
        while len(on_disk()) < COUNT // 2:
            assert deferred_volumes.work(0.0)
    elif state_wanted == "written":
        while deferred_volumes.work(0.0):
            pass


def on_disk() -> list[Path]:
    return sorted(session_folder().rglob("prim_*.vdb"))


def check_complete(person: bpy.types.Object) -> None:
    """Every volume of the human has its file, and nothing is left to write."""
    paths = paths_of(person)
    assert len(paths) == COUNT
    assert all(path.is_file() for path in paths)
    assert pending_of(person) is None
    assert not list(paths[0].parent.glob(".*.partial*"))
