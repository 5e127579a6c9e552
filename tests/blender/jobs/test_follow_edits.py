"""A result that waits to enter the scene, and all that can happen meanwhile; an edit is one undo step."""

from __future__ import annotations

import time
from pathlib import Path

import bpy
import pytest
import synthetic_shape
from human_files import folder_of, forget_session_files, paths_of, person_file
from jobs_driven import drive, error_of, notice_of
from oracle import evaluated_matrices

from blender_primdiffusion.jobs.follow import follow
from blender_primdiffusion.jobs.generate import EditJob, GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.scene.volume_nodes import volumes_of

pytestmark = pytest.mark.any_blender

FINE = 8
"""A seed that is no order to the fake child."""
COUNT = 12
"""Primitives of the synthetic person."""


@pytest.fixture
def person(addon, tmp_path, monkeypatch):
    monkeypatch.setenv("FAKE_HUMAN", str(synthetic_shape.write(tmp_path / "prepared", COUNT)))
    bpy.ops.primdiffusion.generate(seed=7)
    bpy.ops.ed.undo_push(message="a person")
    return humans(addon.scene)[0]


@pytest.fixture
def varied(person):
    """The person, whose edit waits to enter."""
    vary(person)
    until_ready()
    return person


@pytest.fixture
def generated(addon):
    """A human that waits to enter."""
    bpy.ops.ed.undo_push(message="before")
    queue.add(addon, GenerateJob(7, {"steps": 1}))
    until_ready()
    return addon


def vary(person, seed: int = FINE) -> None:
    queue.add(bpy.context, EditJob.of("vary", person, {"steps": 2, "amount": 0.5, "seed": seed}))


def until_ready(seconds: float = 300.0) -> None:
    """Until the result is there, which the scene does not show yet."""
    end = time.monotonic() + seconds
    while not queue.ready:
        assert time.monotonic() < end
        queue.tick()
        time.sleep(0.005)


def check_whole(person, count: int = COUNT) -> None:
    files = paths_of(person)
    assert len(files) == count
    assert all(path.parent == folder_of(person) for path in files)
    assert len(evaluated_matrices(person)) == count
    assert not list(folder_of(person).glob(".*.partial*"))


def current() -> bpy.types.Object:
    return humans(bpy.context.scene)[0]


def test_a_name_taken_meanwhile_is_left(generated):
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Human", None))
    drive()
    assert current().name == "Human.001"


def test_another_file_loaded_meanwhile_gets_no_human(generated):
    bpy.ops.wm.read_homefile(use_empty=True)
    drive()
    assert not humans(bpy.context.scene)


def test_undo_that_makes_the_person_another_meanwhile_rejects_the_result(person):
    vary(person)
    drive()
    vary(person, FINE + 1)
    until_ready()
    bpy.ops.ed.undo()
    before = person_file(current())
    drive()
    assert "changed during the edit" in error_of("vary")
    assert person_file(current()) == before
    bpy.ops.ed.redo()
    check_whole(current())


def test_volumes_deleted_meanwhile_stay_so(varied):
    bpy.data.objects.remove(volumes_of(varied))
    drive()
    assert notice_of("vary").startswith("Varied Human in ")
    assert volumes_of(varied) is None


def test_a_person_reshaped_meanwhile_keeps_that_shape(varied):
    armature = varied
    armature.primdiffusion_human.betas[0] = 1.25
    drive()
    assert armature.primdiffusion_human.betas[0] == pytest.approx(1.25)
    check_whole(varied)


def test_saved_elsewhere_or_without_its_temporary_files_a_person_is_edited(varied, tmp_path):
    (tmp_path / "film").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "film" / "other.blend"))
    forget_session_files()
    drive()
    check_whole(current())


def test_cancel_leaves_the_person_as_they_were(varied):
    before = person_file(varied)
    bpy.ops.primdiffusion.cancel()
    drive()
    assert notice_of("vary") == "Cancelled"
    assert person_file(varied) == before
    check_whole(varied)


def test_a_failure_leaves_the_person_as_they_were(varied, monkeypatch):
    before = person_file(varied)
    monkeypatch.setattr("blender_primdiffusion.scene.edit.check_editable", lambda _: 1 / 0)
    drive()
    assert error_of("vary")
    assert person_file(current()) == before


def test_a_script_that_takes_the_result_gets_the_whole_edit(varied):
    before: list[Path] = paths_of(varied)
    bpy.ops.primdiffusion.apply_result()
    assert follow() is None
    assert not set(paths_of(current())) & set(before)
    check_whole(current())
