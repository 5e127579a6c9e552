"""A Blender that has numpy but not openvdb: humans stand and are drawn; only their volumes cannot be written."""

from __future__ import annotations

import bpy
import pytest
from blender_primdiffusion.jobs.deferred_volumes import deferred_volumes, open_after_loading
from deferred_volumes_stage import COUNT, on_disk
from human_files import person_file
from support.errors import refused

from blender_primdiffusion.scene import volumes
from blender_primdiffusion.scene.human import humans, volumes_of
from blender_primdiffusion.scene.volumes import Memory, person_memory

pytestmark = pytest.mark.any_blender


@pytest.fixture
def without_openvdb(monkeypatch):
    """Blender's Python lacks the module."""
    monkeypatch.setattr(volumes, "_openvdb", None)


@pytest.fixture
def person(without_openvdb, person):
    """The human, generated in such a Blender."""
    return person


def test_a_human_is_generated_with_the_file_that_the_engine_draws(person):
    assert len(volumes_of(person)) == COUNT
    assert person_file(person).is_file()


def test_the_panel_says_why_no_volume_is_written_and_writing_stops(person):
    while deferred_volumes.work(0.0):
        pass
    assert "python3-openvdb" in deferred_volumes.error
    assert not on_disk()
    assert person_memory(person) == Memory(0, 0)


def test_loading_and_rendering_report_it_without_an_exception(person):
    open_after_loading()
    deferred_volumes.finish()
    assert "python3-openvdb" in deferred_volumes.error


def test_what_cannot_wait_is_refused_and_adds_no_human(without_openvdb, addon):
    with refused(RuntimeError, "python3-openvdb"):
        bpy.ops.primdiffusion.generate(seed=7, steps=1)
    assert not humans(bpy.context.scene)
