"""A human whose volumes are deferred is undone, saved, moved, appended, edited and duplicated."""

from __future__ import annotations

import shutil

import bpy
import pytest
from blender_primdiffusion.jobs.deferred_volumes import deferred_volumes
from deferred_volumes_stage import advance, check_complete, on_disk, paths_of
from human_files import copy_of, press_x
from jobs_driven import drive

from blender_primdiffusion.scene import volumes
from blender_primdiffusion.scene.human import humans, volumes_of

ops = bpy.ops.primdiffusion


def test_undo_redo_and_work_again(in_each_state):
    bpy.ops.ed.undo()
    assert not humans(bpy.context.scene)
    assert not deferred_volumes.work(0.0), "no human is left to write"
    bpy.ops.ed.redo()
    (person,) = humans(bpy.context.scene)
    advance("written")
    check_complete(person)


def test_a_deleted_human_is_not_written_on_and_comes_back_with_undo(in_each_state):
    before = on_disk()
    bpy.ops.ed.undo_push(message="stands")
    press_x(in_each_state)
    bpy.ops.ed.undo_push(message="deleted")
    assert not deferred_volumes.work(0.0)
    assert on_disk() == before
    bpy.ops.ed.undo()
    advance("written")
    check_complete(*humans(bpy.context.scene))


def test_saved_and_opened_again_the_rest_is_written(in_each_state):
    bpy.ops.wm.save_mainfile()
    deferred_volumes.stop()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    (person,) = humans(bpy.context.scene)
    advance("written")
    check_complete(person)


def test_the_blend_may_be_moved_before_they_are_written(in_each_state, tmp_path):
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True)
    (tmp_path / "away").mkdir()
    shutil.move(tmp_path / "shot.blend", tmp_path / "away")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "away" / "shot.blend"))
    advance("written")
    check_complete(*humans(bpy.context.scene))


@pytest.mark.parametrize("link", [False, True])
def test_appended_or_linked_the_rest_is_written(in_each_state, tmp_path, link):
    bpy.ops.wm.save_mainfile()
    source = bpy.data.filepath
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(source, link=link) as (_, wanted):
        wanted.collections = ["Human"]
    bpy.context.scene.collection.children.link(bpy.data.collections["Human"])
    (person,) = humans(bpy.context.scene)
    advance("written")
    check_complete(person)


def test_a_library_override_of_a_human_is_written(in_each_state):
    bpy.ops.wm.save_mainfile()
    source = bpy.data.filepath
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(source, link=True) as (_, wanted):
        wanted.collections = ["Human"]
    linked = bpy.data.collections["Human"]
    bpy.context.scene.collection.children.link(linked)
    linked.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    person = next(person for person in humans(bpy.context.scene) if person.override_library is not None)
    advance("written")
    check_complete(person)


def test_an_edit_in_each_state_ends_with_the_volumes_of_the_edit(in_each_state):
    before = set(paths_of(in_each_state))
    assert ops.vary(human=in_each_state.name, seed=8, steps=1) == {"FINISHED"}
    drive()
    after = set(paths_of(in_each_state))
    assert before.isdisjoint(after)
    advance("written")
    check_complete(in_each_state)
    bpy.ops.ed.undo()
    (person,) = humans(bpy.context.scene)
    assert set(paths_of(person)) == before
    advance("written")
    check_complete(person)


def test_a_duplicate_shares_what_is_still_to_be_written(in_each_state):
    twin = copy_of(in_each_state)
    advance("written")
    for person in (in_each_state, twin):
        check_complete(person)
    assert all(obj.parent == twin for objects in volumes_of(twin).values() for obj in objects)


def test_what_failed_is_tried_again_when_the_file_is_opened(person, monkeypatch):
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    bpy.ops.wm.save_mainfile()
    monkeypatch.setattr(volumes, "write_vdb", full)
    while deferred_volumes.work(0.0):
        pass
    monkeypatch.undo()
    assert not deferred_volumes.work(0.0)
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert deferred_volumes.error == ""
    advance("written")
    check_complete(*humans(bpy.context.scene))
