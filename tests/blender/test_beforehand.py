"""Volumes written and read before the person is in the scene."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest
import synthetic
import synthetic_shape

from blender_primdiffusion.scene import beforehand, build
from blender_primdiffusion.scene.beforehand import Place
from blender_primdiffusion.scene.build import build_human, build_written, home_of_next
from blender_primdiffusion.scene.files import VolumeWriteError, folder_of, volume_path
from blender_primdiffusion.scene.grid_cache import read_grids
from blender_primdiffusion.scene.human_npz import HumanFileError
from blender_primdiffusion.scene.shape import shape_model_of


def written_at_once(human_npz: Path, place: Place) -> beforehand.Written:
    written = beforehand.Writing(human_npz, place).take()
    assert written is not None
    return written


@pytest.fixture
def source(saved_scene, tmp_path):
    return synthetic_shape.write(tmp_path / "human.npz")


@pytest.fixture
def keep(tmp_path):
    path = tmp_path / "person.human.safetensors"
    path.write_bytes(b"a person")
    return path


def on_disk(folder) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def volumes_in_order(person) -> list[str]:
    return sorted(volume_path(thing.data).name for thing in person.all_objects if thing.type == "VOLUME")


def state(person):
    """What distinguishes people, and no names."""
    armature = next(thing for thing in person.objects if thing.type == "ARMATURE")
    at = {volume_path(t.data).name: t.matrix_world.copy().freeze() for t in person.all_objects if t.type == "VOLUME"}
    return at, armature["primdiffusion_betas"].to_list(), person["primdiffusion_human"], armature.location.copy()


def test_a_person_written_before_is_the_one_that_is_built_at_once(saved_scene, source, keep, tmp_path):
    written = written_at_once(source, Place(home_of_next("Anna")))
    early = build_written(saved_scene, written, "Anna", [keep])
    late = build_human(saved_scene, source, "Berta", [keep])
    saved_scene.view_layer.update()
    assert state(early) == state(late)
    assert folder_of(early) == written.home
    assert {path.name for path in folder_of(early).iterdir()} == {path.name for path in folder_of(late).iterdir()}
    assert shape_model_of(early) is shape_model_of(late)


def test_the_next_home_is_the_one_the_next_person_gets(saved_scene, source):
    build_human(saved_scene, source, "Anna")
    collections = set(bpy.data.collections)
    home = home_of_next("Anna")
    assert set(bpy.data.collections) == collections
    assert folder_of(build_human(saved_scene, source, "Anna")) == home


def test_a_place_taken_meanwhile_is_left_to_who_has_it(saved_scene, source, keep, tmp_path):
    written = written_at_once(source, Place(home_of_next("Anna")))
    bpy.data.collections.new("Anna")
    person = build_written(saved_scene, written, "Anna", [keep])
    assert person.name == "Anna.001"
    assert not written.home.exists()
    assert all(volume_path(t.data).is_file() for t in person.all_objects if t.type == "VOLUME")
    assert (folder_of(person) / keep.name).is_file()
    assert shape_model_of(person).template.shape[1] == 3


def test_a_file_saved_meanwhile_has_the_person_beside_it(empty_scene, tmp_path):
    source = synthetic_shape.write(tmp_path / "human.npz")
    written = written_at_once(source, Place(home_of_next("Anna")))
    (tmp_path / "film").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "film" / "shot.blend"))
    person = build_written(empty_scene, written, "Anna")
    assert folder_of(person) == tmp_path / "film" / "shot_humans" / "Anna"
    assert not written.home.exists()
    assert all(not path.exists() for path in written.made)
    assert all(volume_path(t.data).is_file() for t in person.all_objects if t.type == "VOLUME")
    assert shape_model_of(person).template.shape[1] == 3


def test_discarding_leaves_what_others_had(saved_scene, source, tmp_path):
    person = build_human(saved_scene, source, "Anna")
    before = on_disk(tmp_path)
    again = written_at_once(source, Place(folder_of(person)))  # as after the person was deleted and made again
    again.discard()
    written_at_once(source, Place(home_of_next("Anna"))).discard()
    assert on_disk(tmp_path) == before


def test_a_file_that_the_system_keeps_is_no_reason_to_leave_the_others(saved_scene, source, monkeypatch):
    written, unlink = written_at_once(source, Place(home_of_next("Anna"))), Path.unlink

    def as_on_windows(path: Path, missing_ok: bool = False) -> None:
        if path == written.files[2]:
            raise PermissionError(13, "it is used by another process", str(path))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", as_on_windows)
    written.discard()
    assert [path for path in written.made if path.exists()] == [written.files[2]]


def test_a_failure_while_building_removes_what_was_written(saved_scene, source, tmp_path, monkeypatch):
    before = on_disk(tmp_path)
    written = written_at_once(source, Place(home_of_next("Anna")))

    def failing(*_):
        raise MemoryError("no memory for the volumes")

    monkeypatch.setattr(build, "attach_volumes", failing)
    with pytest.raises(MemoryError):
        build_written(saved_scene, written, "Anna")
    assert on_disk(tmp_path) == before
    assert not bpy.data.volumes
    assert not bpy.data.collections


def test_slices_write_a_file_at_a_time(saved_scene, source):
    writing = beforehand.Writing(source, Place(home_of_next("Anna")))
    fractions = []
    while not writing.over:
        writing.work(0.0)
        fractions.append(writing.fraction)
    assert writing.error is None
    assert writing.result is not None
    assert writing.result.whole()
    assert fractions == sorted(fractions)
    assert len(set(fractions)) >= len(writing.result.files)
    writing.result.files[3].unlink()
    assert not writing.result.whole()


@pytest.mark.parametrize("steps", [0, 1, 5, 40, 1000])
def test_stopped_writing_leaves_no_files_however_far_it_was(saved_scene, tmp_path, steps):
    source = synthetic.write(tmp_path / "human.npz", 64)
    before = on_disk(tmp_path)
    writing = beforehand.Writing(source, Place(home_of_next("Anna")))
    for _ in range(steps):
        writing.work(0.0)
    assert (on_disk(tmp_path) != before) == (steps >= 5)
    writing.stop()
    assert writing.over
    assert writing.result is None
    assert on_disk(tmp_path) == before


def test_writing_keeps_its_failure_for_its_caller(saved_scene, tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"nothing")
    bad = beforehand.Writing(tmp_path / "bad.npz", Place(home_of_next("Anna")))
    (tmp_path / "shot_humans").write_text("in the way")
    full = beforehand.Writing(synthetic.write(tmp_path / "human.npz", 2), Place(home_of_next("Anna")))
    for writing in (bad, full):
        assert writing.take() is None
    assert isinstance(bad.error, HumanFileError)
    assert isinstance(full.error, VolumeWriteError)


def test_grids_read_before_are_there_when_volumes_show_them_and_nothing_else_is(saved_scene, source):
    written = written_at_once(source, Place(home_of_next("Anna")))
    read = 0
    while read < len(written.files):
        count = read_grids(written.files[read:], 0.0)
        assert count == 1
        read += count
    assert read_grids(written.files, 60.0) == len(written.files)
    assert not bpy.data.volumes
    person = build_written(saved_scene, written, "Anna")
    saved_scene.view_layer.update()
    volume = next(thing.data for thing in person.all_objects if thing.type == "VOLUME")
    assert volume.grids.load()
    assert {grid.name for grid in volume.grids} == {"density", "Cd"}


def test_a_missing_file_is_no_reason_not_to_read_the_others(saved_scene, source):
    written = written_at_once(source, Place(home_of_next("Anna")))
    written.files[0].unlink()
    assert read_grids(written.files, 60.0) == len(written.files)
