"""Volumes written and read before the person is in the scene."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest
import synthetic
import synthetic_shape

from blender_primdiffusion.scene import build
from blender_primdiffusion.scene.body_file import shape_model_of
from blender_primdiffusion.scene.build import build_human, build_written, next_folder
from blender_primdiffusion.scene.human import VolumeWriteError, folder_of, volume_path
from blender_primdiffusion.scene.human_npz import Destination, HumanNpzError, VolumeWriter, write_now


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
    return sorted(volume_path(obj.data).name for obj in person.all_objects if obj.type == "VOLUME")


def state(person):
    """What distinguishes people, and no names."""
    armature = next(obj for obj in person.objects if obj.type == "ARMATURE")
    at = {volume_path(t.data).name: t.matrix_world.copy().freeze() for t in person.all_objects if t.type == "VOLUME"}
    return at, armature["primdiffusion_betas"].to_list(), person["primdiffusion_human"], armature.location.copy()


def test_a_person_written_before_is_the_one_that_is_built_at_once(saved_scene, source, keep, tmp_path):
    written = write_now(source, Destination(next_folder("Anna")))
    early = build_written(saved_scene, written, "Anna", [keep])
    late = build_human(saved_scene, source, "Berta", [keep])
    saved_scene.view_layer.update()
    assert state(early) == state(late)
    assert folder_of(early) == written.folder
    assert {path.name for path in folder_of(early).iterdir()} == {path.name for path in folder_of(late).iterdir()}
    assert shape_model_of(early) is shape_model_of(late)


def test_the_next_home_is_the_one_the_next_person_gets(saved_scene, source):
    build_human(saved_scene, source, "Anna")
    collections = set(bpy.data.collections)
    home = next_folder("Anna")
    assert set(bpy.data.collections) == collections
    assert folder_of(build_human(saved_scene, source, "Anna")) == home


def test_a_place_taken_meanwhile_is_left_to_who_has_it(saved_scene, source, keep, tmp_path):
    written = write_now(source, Destination(next_folder("Anna")))
    bpy.data.collections.new("Anna")
    person = build_written(saved_scene, written, "Anna", [keep])
    assert person.name == "Anna.001"
    assert not written.folder.exists()
    assert all(volume_path(t.data).is_file() for t in person.all_objects if t.type == "VOLUME")
    assert (folder_of(person) / keep.name).is_file()
    assert shape_model_of(person).template.shape[1] == 3


def test_a_file_saved_meanwhile_has_the_person_beside_it(empty_scene, tmp_path):
    source = synthetic_shape.write(tmp_path / "human.npz")
    written = write_now(source, Destination(next_folder("Anna")))
    (tmp_path / "film").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "film" / "shot.blend"))
    person = build_written(empty_scene, written, "Anna")
    assert folder_of(person) == tmp_path / "film" / "shot_humans" / "Anna"
    assert not written.folder.exists()
    assert all(not path.exists() for path in written.made)
    assert all(volume_path(t.data).is_file() for t in person.all_objects if t.type == "VOLUME")
    assert shape_model_of(person).template.shape[1] == 3


def test_discarding_leaves_what_others_had(saved_scene, source, tmp_path):
    person = build_human(saved_scene, source, "Anna")
    before = on_disk(tmp_path)
    again = write_now(source, Destination(folder_of(person)))  # as after the person was deleted and made again
    again.discard()
    write_now(source, Destination(next_folder("Anna"))).discard()
    assert on_disk(tmp_path) == before


def test_a_file_that_the_system_keeps_is_no_reason_to_leave_the_others(saved_scene, source, monkeypatch):
    written, unlink = write_now(source, Destination(next_folder("Anna"))), Path.unlink

    def as_on_windows(path: Path, missing_ok: bool = False) -> None:
        if path == written.files[2]:
            raise PermissionError(13, "it is used by another process", str(path))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", as_on_windows)
    written.discard()
    assert [path for path in written.made if path.exists()] == [written.files[2]]


def test_a_failure_while_building_removes_what_was_written(saved_scene, source, tmp_path, monkeypatch):
    before = on_disk(tmp_path)
    written = write_now(source, Destination(next_folder("Anna")))

    def failing(*_):
        raise MemoryError("no memory for the volumes")

    monkeypatch.setattr(build, "attach_volumes", failing)
    with pytest.raises(MemoryError):
        build_written(saved_scene, written, "Anna")
    assert on_disk(tmp_path) == before
    assert not bpy.data.volumes
    assert not bpy.data.collections


def test_slices_write_a_file_at_a_time(saved_scene, source):
    writer = VolumeWriter(source, Destination(next_folder("Anna")))
    fractions = []
    while not writer.over:
        writer.work(0.0)
        fractions.append(writer.fraction)
    assert writer.error is None
    assert writer.result is not None
    assert writer.result.complete()
    assert fractions == sorted(fractions)
    assert len(set(fractions)) >= len(writer.result.files)
    writer.result.files[3].unlink()
    assert not writer.result.complete()


@pytest.mark.parametrize("steps", [0, 1, 5, 40, 1000])
def test_stopped_writing_leaves_no_files_however_far_it_was(saved_scene, tmp_path, steps):
    source = synthetic.write(tmp_path / "human.npz", 64)
    before = on_disk(tmp_path)
    writer = VolumeWriter(source, Destination(next_folder("Anna")))
    for _ in range(steps):
        writer.work(0.0)
    assert (on_disk(tmp_path) != before) == (steps >= 5)
    writer.stop()
    assert writer.over
    assert writer.result is None
    assert on_disk(tmp_path) == before


def test_writing_keeps_its_failure_for_its_caller(saved_scene, tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"nothing")
    bad = VolumeWriter(tmp_path / "bad.npz", Destination(next_folder("Anna")))
    (tmp_path / "shot_humans").write_text("in the way")
    full = VolumeWriter(synthetic.write(tmp_path / "human.npz", 2), Destination(next_folder("Anna")))
    for writer in (bad, full):
        assert writer.take() is None
    assert isinstance(bad.error, HumanNpzError)
    assert isinstance(full.error, VolumeWriteError)
