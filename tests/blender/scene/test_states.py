"""The files of a state, made before the person is in the scene."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest
import synthetic
import synthetic_shape
from blender_primdiffusion.formats.regular_files import FileError
from support.errors import refused

from blender_primdiffusion.scene import attachment, build, states
from blender_primdiffusion.scene.build import build_human, build_prepared
from blender_primdiffusion.scene.human import folder_of, new_state, person_file, remove_state, state_folder, volume_path
from blender_primdiffusion.scene.rest_human import shape_model_of
from blender_primdiffusion.scene.states import Preparation, next_folder, prepare_now


@pytest.fixture
def source(saved_scene, tmp_path):
    return synthetic_shape.write(tmp_path / "human")


def on_disk(folder) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def state(person):
    """What distinguishes people, and no names."""
    armature = next(obj for obj in person.objects if obj.type == "ARMATURE")
    at = {volume_path(t.data).name: t.matrix_world.copy().freeze() for t in person.all_objects if t.type == "VOLUME"}
    return at, armature["primdiffusion_betas"].to_list(), person["primdiffusion_human"], armature.location.copy()


def test_a_person_prepared_before_is_the_one_that_is_built_at_once(saved_scene, source):
    prepared = prepare_now(source, "Anna")
    early = build_prepared(saved_scene, prepared, "Anna")
    late = build_human(saved_scene, source, "Berta")
    saved_scene.view_layer.update()
    assert state(early) == state(late)
    assert state_folder(early) == prepared.folder == folder_of(early) / "0001"
    assert {path.name for path in state_folder(early).iterdir()} == {path.name for path in state_folder(late).iterdir()}


def test_without_a_window_all_volumes_are_there_and_with_one_they_may_wait(saved_scene, source, monkeypatch):
    assert len(list(prepare_now(source).folder.glob("prim_*.vdb"))) == 12
    monkeypatch.setattr(states, "volumes_may_wait", lambda person: not attachment.VOLUMES_IN_VIEWPORT)
    assert sorted(path.name for path in prepare_now(source).folder.iterdir()) == ["body.safetensors", source.name]


def test_the_next_folder_is_the_one_the_next_person_gets(saved_scene, source):
    build_human(saved_scene, source, "Anna")
    collections = set(bpy.data.collections)
    home = next_folder("Anna")
    assert set(bpy.data.collections) == collections
    assert folder_of(build_human(saved_scene, source, "Anna")) == home


def test_a_name_taken_meanwhile_changes_no_files(saved_scene, source):
    prepared = prepare_now(source, "Anna")
    bpy.data.collections.new("Anna")
    person = build_prepared(saved_scene, prepared, "Anna")
    assert person.name == "Anna.001"
    assert all(volume_path(t.data).is_file() for t in person.all_objects if t.type == "VOLUME")
    assert person_file(person).parent == prepared.folder
    assert shape_model_of(person).template.shape[1] == 3


def test_numbers_count_up_and_are_not_used_again(tmp_path):
    home = tmp_path / "shot_humans" / "Anna"
    first, second = new_state(home), new_state(home)
    (first / "file").write_text("mine")
    remove_state(second)
    (home / "0007").mkdir()
    assert [path.name for path in (first, second, new_state(home))] == ["0001", "0002", "0008"]


def test_the_number_of_a_state_that_was_shown_and_removed_is_not_used_again(addon, tmp_path):
    """Blender would show the grids that it has read from files of that name."""
    source = synthetic_shape.write(tmp_path / "human")
    person = build_human(addon, source, "Anna")
    removed = state_folder(person)
    bpy.ops.primdiffusion.delete_human(human="Anna")
    bpy.ops.primdiffusion.remove_unused_files()
    assert not removed.exists()
    assert state_folder(build_human(addon, source, "Anna")) == removed.with_name("0002")


def test_a_link_in_place_of_the_folder_is_not_followed(saved_scene, source, tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "shot_humans").mkdir()
    (tmp_path / "shot_humans" / "Anna").symlink_to(tmp_path / "outside")
    with refused(FileError, "Anna", "link"):
        prepare_now(source, "Anna")
    assert list((tmp_path / "outside").iterdir()) == []


def test_a_failure_while_building_removes_what_was_written(saved_scene, source, tmp_path, monkeypatch):
    before = on_disk(tmp_path)
    prepared = prepare_now(source, "Anna")

    def failing(*_):
        raise MemoryError("no memory for the volumes")

    monkeypatch.setattr(build, "attach_volumes", failing)
    with pytest.raises(MemoryError):
        build_prepared(saved_scene, prepared, "Anna")
    assert on_disk(tmp_path) == before
    assert not bpy.data.volumes
    assert not bpy.data.collections


@pytest.mark.parametrize("steps", [0, 1, 5, 40, 1000])
def test_stopped_preparing_leaves_no_files_however_far_it_was(saved_scene, tmp_path, steps):
    source = synthetic.write(tmp_path / "human", 64)
    before = on_disk(tmp_path)
    preparation = Preparation(source, "Anna")
    for _ in range(steps):
        preparation.work(0.0)
    assert (on_disk(tmp_path) != before) == (steps >= 5)
    preparation.stop()
    assert preparation.over
    assert preparation.take() is None
    assert on_disk(tmp_path) == before


def test_a_preparation_that_failed_or_whose_folder_is_gone_is_not_taken(saved_scene, source, tmp_path):
    (tmp_path / "bad.human").write_bytes(b"nothing")
    bad, removed = Preparation(tmp_path / "bad.human", "Anna"), Preparation(source, "Anna")
    removed.work(float("inf"))
    remove_state(removed.result.folder)
    (tmp_path / "shot_humans").write_text("in the way")
    full = Preparation(source, "Anna")
    assert [preparation.take() for preparation in (bad, removed, full)] == [None] * 3


def test_a_human_in_the_file_of_a_moved_temporary_folder_is_found_again(empty_scene, tmp_path):
    person = build_human(empty_scene, synthetic_shape.write(tmp_path / "human"))
    assert Path(bpy.app.tempdir) in state_folder(person).parents
