"""Each .blend has the files of its humans in its own folder: deleting another one with its folder breaks nothing."""

from __future__ import annotations

import os
import shutil

import bpy
import pytest
from human_stage import COUNT, build_posed, named, places, whole

from blender_primdiffusion.scene import human
from blender_primdiffusion.scene.human import folder_of, person_file, volume_path, volumes_of

ops = bpy.ops.primdiffusion


@pytest.fixture(params=["hard links", "copies"])
def disk(request, monkeypatch):
    """A disk with hard links, and one without."""
    if request.param == "copies":
        monkeypatch.setattr(human, "_linked", lambda *_: False)
    return request.param


def delete(blend):
    blend.unlink()
    shutil.rmtree(blend.with_name(f"{blend.stem}_humans"))


def opened(blend):
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    return named()


def folders() -> set:
    return {volume_path(volume).parent for volume in bpy.data.volumes}


@pytest.mark.parametrize("deleted", ["shot", "second"])
@pytest.mark.parametrize("place", ["", "elsewhere"])
def test_after_save_as_either_file_may_be_deleted(person, tmp_path, disk, deleted, place):
    where = places(person)
    (tmp_path / place).mkdir(exist_ok=True)
    files = {"shot": tmp_path / "shot.blend", "second": tmp_path / place / "second.blend"}
    bpy.ops.wm.save_as_mainfile(filepath=str(files["second"]))
    assert whole(person, where)
    assert folders() == {tmp_path / place / "second_humans" / "Anna" / "0001"}
    delete(files.pop(deleted))
    (kept,) = files.values()
    assert whole(opened(kept), where)


@pytest.mark.parametrize("deleted", ["shot", "copy"])
def test_after_save_copy_either_file_may_be_deleted(person, tmp_path, deleted):
    where = places(person)
    before = {volume.name: volume.filepath for volume in bpy.data.volumes}
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "copy.blend"), copy=True)
    assert {volume.name: volume.filepath for volume in bpy.data.volumes} == before
    delete(tmp_path / f"{deleted}.blend")
    assert whole(opened(tmp_path / ("shot.blend" if deleted == "copy" else "copy.blend")), where)


def test_hard_links_take_no_space(person, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    for path in (tmp_path / "second_humans").rglob("*.*"):
        assert path.samefile(tmp_path / "shot_humans" / path.relative_to(tmp_path / "second_humans"))


def test_an_edit_of_one_leaves_the_other(person, tmp_path, disk):
    first = {path: path.read_bytes() for path in (tmp_path / "shot_humans").rglob("*.*")}
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    assert ops.vary(seed=13) == {"FINISHED"}
    bpy.ops.wm.save_mainfile()
    ops.remove_unused_files()
    assert {path: path.read_bytes() for path in (tmp_path / "shot_humans").rglob("*.*")} == first
    assert whole(opened(tmp_path / "shot.blend"))
    assert whole(opened(tmp_path / "second.blend"))


def test_appended_humans_belong_to_the_file_once_it_is_saved(person, tmp_path):
    where = places(person)
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "film.blend"))
    bpy.ops.wm.append(directory=str(tmp_path / "shot.blend" / "Collection") + os.sep, filename="Anna")
    bpy.ops.wm.save_mainfile()
    delete(tmp_path / "shot.blend")
    assert whole(opened(tmp_path / "film.blend"), where)


def test_a_file_that_was_copied_by_hand_has_its_own_folder_once_it_is_saved(person, tmp_path):
    shutil.copy(tmp_path / "shot.blend", tmp_path / "by hand.blend")
    opened(tmp_path / "by hand.blend")
    bpy.ops.wm.save_mainfile()
    delete(tmp_path / "shot.blend")
    assert whole(opened(tmp_path / "by hand.blend"))


def test_a_human_of_another_file_with_the_same_name_gets_a_folder_of_its_own(source, person, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    ops.vary(seed=13)
    varied = person_file(named()).read_bytes()
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.append(directory=str(tmp_path / "shot.blend" / "Collection") + os.sep, filename="Anna")
    bpy.ops.wm.save_mainfile()
    delete(tmp_path / "shot.blend")
    assert whole(opened(tmp_path / "second.blend"))
    assert whole(named("Anna.001"))
    assert person_file(named()).read_bytes() == varied != person_file(named("Anna.001")).read_bytes()


def test_a_save_that_fails_changes_nothing(person, tmp_path):
    where, before = places(person), {volume.name: volume.filepath for volume in bpy.data.volumes}
    (tmp_path / "second.blend@").mkdir()  # the name that Blender writes to first
    with pytest.raises(RuntimeError):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    assert {volume.name: volume.filepath for volume in bpy.data.volumes} == before
    assert not (tmp_path / "second_humans").exists()
    assert whole(person, where)


def test_a_human_without_volumes_keeps_its_own_file(person, tmp_path):
    bpy.data.batch_remove([obj for objects in volumes_of(person).values() for obj in objects])
    bpy.data.orphans_purge()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    delete(tmp_path / "shot.blend")
    assert person_file(opened(tmp_path / "second.blend")).parent == tmp_path / "second_humans" / "Anna" / "0001"


def test_a_save_of_unchanged_humans_writes_no_file(person, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.scene.collect.copy_file", lambda *_, **__: pytest.fail("copied"))
    bpy.ops.wm.save_mainfile()
    assert len(list(folder_of(person).glob("*/prim_*"))) == COUNT


def test_undo_to_before_save_as_and_saved_again(source, person, tmp_path):
    bpy.ops.ed.undo_push(message="before")
    build_posed(source, "Berta")
    bpy.ops.ed.undo_push(message="built")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    bpy.ops.ed.undo()
    bpy.ops.wm.save_mainfile()
    delete(tmp_path / "shot.blend")
    assert whole(opened(tmp_path / "second.blend"))
