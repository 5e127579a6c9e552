"""A human that enters the scene a slice of time at a time, and all that can happen before it is there."""

from __future__ import annotations

import time
from pathlib import Path

import bpy
import pytest
import synthetic_shape
from jobs_driven import drive, error_of, notice_of

import blender_primdiffusion
from blender_primdiffusion.jobs import follow as follow_module
from blender_primdiffusion.jobs.follow import building, follow
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene import volumes
from blender_primdiffusion.scene.human import folder_of, humans, person_file, state_folder, volume_path
from blender_primdiffusion.scene.rest_human import shape_model_of

pytestmark = pytest.mark.any_blender

COUNT = 12
"""Primitives of the synthetic person."""


@pytest.fixture
def on_their_way(addon, tmp_path, monkeypatch):
    """A person of whose volumes some are written."""
    monkeypatch.setenv("FAKE_HUMAN", str(synthetic_shape.write(tmp_path / "prepared", COUNT)))
    monkeypatch.setattr("blender_primdiffusion.jobs.follow.SLICE_S", 0.0)
    bpy.ops.ed.undo_push(message="before")
    queue.add(addon, GenerateJob(7, {"steps": 1}))
    until(lambda: 0.4 < building.fraction < 1.0)
    return addon


def until(true, seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        assert follow() is not None
        time.sleep(0.005)


def files_of_people(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file() and "_humans" in str(path.parent)]


def check_whole(person: bpy.types.Collection) -> None:
    shown = [volume_path(obj.data) for obj in person.all_objects if obj.type == "VOLUME"]
    assert len(shown) == COUNT
    assert all(path.is_file() and path.parent == state_folder(person) for path in shown)
    assert person_file(person).parent == state_folder(person)
    assert shape_model_of(person).template.shape[1] == 3
    assert not list(state_folder(person).glob(".*.partial*"))


def test_no_tick_writes_more_than_its_slice(addon, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.jobs.follow.SLICE_S", 0.0)
    written, write_vdb, ticks = [], volumes.write_vdb, [0]
    monkeypatch.setattr(volumes, "write_vdb", lambda *args: written.append(ticks[0]) or write_vdb(*args))
    queue.add(addon, GenerateJob(7, {"steps": 1}))
    while follow() is not None:
        ticks[0] += 1
    assert len(written) == len(set(written)) == 8
    assert len(humans(addon.scene)) == 1


def test_the_bar_continues_while_volumes_are_written(addon, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.jobs.follow.SLICE_S", 0.0)
    queue.add(addon, GenerateJob(7, {"steps": 1}))
    seen = []
    while follow() is not None:
        if queue.ready:
            seen.append(building.fraction)
    assert seen == sorted(seen)
    assert len(set(seen)) >= 8
    assert building.fraction == 1.0


def test_nothing_of_it_is_in_the_file_until_it_enters_in_one_undo_step(on_their_way):
    assert not bpy.data.volumes
    assert not bpy.data.collections
    drive()
    (person,) = humans(bpy.context.scene)
    check_whole(person)
    bpy.ops.ed.undo()
    assert not humans(bpy.context.scene)
    assert not bpy.data.volumes
    bpy.ops.ed.redo()
    check_whole(humans(bpy.context.scene)[0])


def test_undo_and_redo_meanwhile_do_no_harm(on_their_way):
    on_their_way.scene.collection.objects.link(bpy.data.objects.new("Cube", None))
    bpy.ops.ed.undo_push(message="a cube")
    follow()
    bpy.ops.ed.undo()
    follow()
    bpy.ops.ed.redo()
    follow()
    bpy.ops.ed.undo()
    drive()
    check_whole(*humans(bpy.context.scene))


def test_saved_elsewhere_meanwhile_the_person_lies_beside_the_file_of_now(on_their_way, tmp_path):
    (tmp_path / "film").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "film" / "other.blend"))
    drive()
    (person,) = humans(bpy.context.scene)
    check_whole(person)
    assert folder_of(person).parent == tmp_path / "film" / "other_humans"
    assert not (tmp_path / "shot_humans").exists()


def test_a_name_taken_meanwhile_is_left(on_their_way):
    bpy.data.collections.new("Human")
    drive()
    (person,) = humans(bpy.context.scene)
    assert person.name == "Human.001"
    check_whole(person)


def test_files_removed_meanwhile_are_written_again(on_their_way):
    bpy.ops.primdiffusion.remove_unused_files()
    drive()
    check_whole(*humans(bpy.context.scene))


def test_a_script_that_does_not_wait_for_the_volumes_gets_the_whole_person(addon):
    queue.add(addon, GenerateJob(7, {"steps": 1}))
    until(lambda: queue.ready)
    bpy.ops.primdiffusion.take_result()
    assert follow() is None
    (person,) = humans(bpy.context.scene)
    assert len(list(state_folder(person).glob("*.vdb"))) == 8


def test_cancel_adds_nothing_and_leaves_no_files(on_their_way, tmp_path):
    bpy.ops.primdiffusion.cancel()
    drive()
    assert notice_of("generate") == "Cancelled"
    assert not humans(bpy.context.scene)
    assert not (tmp_path / "shot_humans").exists()


def test_another_file_loaded_meanwhile_gets_no_human_and_no_files_stay(on_their_way, tmp_path):
    bpy.ops.wm.read_homefile(use_empty=True)
    assert building.fraction == 1.0, "at once: no timer may run any more"
    drive()
    assert not humans(bpy.context.scene)
    assert not (tmp_path / "shot_humans").exists()


def test_disabling_the_extension_leaves_no_files(on_their_way, tmp_path):
    blender_primdiffusion.unregister()
    assert not (tmp_path / "shot_humans").exists()
    blender_primdiffusion.register()


def test_a_scene_deleted_meanwhile_gets_no_human_and_no_files_stay(on_their_way, tmp_path):
    bpy.data.scenes.new("Other")
    bpy.data.scenes.remove(on_their_way.scene)
    drive()
    assert "was deleted meanwhile" in error_of("generate")
    assert not (tmp_path / "shot_humans").exists()


def test_nothing_is_written_while_the_user_holds_something(on_their_way, monkeypatch):
    monkeypatch.setattr(follow_module, "in_the_way", lambda: "Move")
    before = building.fraction
    for _ in range(20):
        assert follow() is not None
    assert building.fraction == before
    assert not humans(bpy.context.scene)
    monkeypatch.undo()
    drive()
    assert len(humans(bpy.context.scene)) == 1


def test_a_folder_that_cannot_be_written_is_reported(addon, tmp_path):
    (tmp_path / "shot_humans").write_text("in the way")
    queue.add(addon, GenerateJob(7, {"steps": 1}))
    drive()
    assert "cannot be written to" in error_of("generate")
    assert not bpy.data.volumes


def test_queued_humans_do_not_disturb_each_other(addon):
    for seed in (11, 12, 13):
        queue.add(addon, GenerateJob(seed, {"steps": 1}))
    drive()
    people = humans(bpy.context.scene)
    assert len({state_folder(person) for person in people}) == 3
    for person in people:
        assert len(list(state_folder(person).glob("*.vdb"))) == 8
