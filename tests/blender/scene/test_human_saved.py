"""People are whole after a .blend was saved, moved, renamed, copied or packed: their files are found or come along."""

from __future__ import annotations

import os
import shutil

import bpy
import pytest
from blender_primdiffusion.formats.regular_files import FileError
from human_stage import build_posed, named, places, whole
from support.errors import refused

from blender_primdiffusion.scene.collect import collect_files
from blender_primdiffusion.scene.human import folder_of, humans_folder, person_file, volume_path
from blender_primdiffusion.scene.missing import missing_files

ops = bpy.ops.primdiffusion
ODD = 'Ä ö\' "x" 100%s 年'


def test_saved_under_another_name_elsewhere_and_then_moved(person, tmp_path):
    where, elsewhere = places(person), tmp_path / ODD
    elsewhere.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(elsewhere / "b.blend"))
    assert whole(named(), where)
    bpy.ops.wm.open_mainfile(filepath=str(elsewhere / "b.blend"))
    assert whole(named(), where)
    sent = tmp_path / "sent"
    shutil.move(elsewhere, sent)
    shutil.rmtree(tmp_path / "shot_humans")
    bpy.ops.wm.open_mainfile(filepath=str(sent / "b.blend"))
    assert whole(named(), where)
    assert person_file(named()).resolve().is_relative_to(sent)


@pytest.mark.parametrize("with_folder", [True, False])
def test_a_blend_that_is_renamed(person, tmp_path, with_folder):
    where = places(person)
    shutil.move(tmp_path / "shot.blend", tmp_path / "final.blend")
    if with_folder:
        shutil.move(tmp_path / "shot_humans", tmp_path / "final_humans")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "final.blend"))
    if with_folder:
        assert missing_files()
        ops.find_missing_volumes()
    assert whole(named(), where)


@pytest.mark.parametrize("with_folder", [True, False])
def test_a_blend_that_is_moved(person, tmp_path, with_folder):
    where, elsewhere = places(person), tmp_path / ODD
    elsewhere.mkdir()
    shutil.move(tmp_path / "shot.blend", elsewhere)
    if with_folder:
        shutil.move(tmp_path / "shot_humans", elsewhere)
    bpy.ops.wm.open_mainfile(filepath=str(elsewhere / "shot.blend"))
    if not with_folder:
        assert missing_files()
        ops.find_missing_volumes()
    assert whole(named(), where)


def test_a_file_never_saved_and_then_saved(source, tmp_path):
    bpy.ops.wm.read_homefile(use_empty=True)
    anna = build_posed(source)
    where, berta = places(anna), build_posed(source, "Berta")
    temporary = folder_of(anna)
    assert temporary.is_relative_to(bpy.app.tempdir)
    folder = tmp_path / ODD
    folder.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "neu.blend"))
    assert whole(anna, where)
    assert whole(berta)
    shutil.rmtree(temporary.parent)
    bpy.ops.wm.open_mainfile(filepath=str(folder / "neu.blend"))
    assert whole(named(), where)
    assert not list(folder.rglob(".*"))


def test_files_of_a_blender_that_crashed_before_the_first_save_come_along(source, tmp_path):
    bpy.ops.wm.read_homefile(use_empty=True)
    anna = build_posed(source)
    crashed = tmp_path / "blender_a1b2c3" / "primdiffusion_humans"
    shutil.move(humans_folder(""), crashed)
    for volume in bpy.data.volumes:
        path = volume_path(volume)
        volume.filepath = str(crashed / "Anna" / path.parent.name / path.name)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "recovered.blend"))
    assert whole(anna)
    assert person_file(anna).is_relative_to(tmp_path / "recovered_humans")


def test_a_copy_in_a_temporary_folder_finds_the_people_of_the_original(person, tmp_path):
    where, other = places(person), tmp_path / "tmp" / "deep"
    other.mkdir(parents=True)
    shutil.copy(tmp_path / "shot.blend", other / "shot_autosave.blend")
    bpy.ops.wm.open_mainfile(filepath=str(other / "shot_autosave.blend"))
    assert missing_files()
    assert ops.find_missing_volumes() == {"FINISHED"}
    assert whole(named(), where)


def test_purging_and_packing_take_nothing_away(person):
    where = places(person)
    bpy.ops.outliner.orphans_purge(do_recursive=True)
    bpy.ops.file.pack_all()
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert whole(named(), where)


def test_a_full_disk_while_saving_or_collecting_leaves_people_as_they_are(person, tmp_path, monkeypatch, capsys):
    import errno

    from blender_primdiffusion.scene import human

    where, other = places(person), tmp_path / "other"
    other.mkdir()
    copy, copied = shutil.copyfile, []

    def full(source, destination):
        if len(copied) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        copied.append(copy(source, destination))

    monkeypatch.setattr(human, "_linked", lambda *_: False)
    monkeypatch.setattr(human.shutil, "copyfile", full)
    bpy.ops.wm.save_as_mainfile(filepath=str(other / "b.blend"))
    assert "humans of this file depend on files elsewhere" in capsys.readouterr().out
    before = {volume.name: volume.filepath for volume in bpy.data.volumes}
    copied.clear()
    with refused(FileError):
        collect_files()
    copied.clear()
    with refused(RuntimeError, "space"):
        ops.collect_files()
    assert {volume.name: volume.filepath for volume in bpy.data.volumes} == before
    assert not [path for path in (other / "b_humans").rglob("*") if path.is_file()]
    assert whole(named(), where)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_reported(person, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(other / "b.blend"))
    other.chmod(0o500)
    with refused(RuntimeError, "permission"):
        ops.collect_files()
    assert whole(named())


def test_a_path_as_long_as_blender_takes(source, tmp_path):
    folder = tmp_path
    while len(str(folder)) < 780:
        folder /= "langer_name_" * 8
    folder.mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "a.blend"))
    build_posed(source)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(folder / "a.blend"))
    assert whole(named())
