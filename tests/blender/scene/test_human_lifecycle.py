"""People are whole after whatever happens to a .blend: volumes in their places, files where the engine finds them."""

from __future__ import annotations

import json
import os
import shutil

import bpy
import numpy as np
import psutil
import pytest
import synthetic
import synthetic_shape
from exporting import write_person
from oracle import evaluated_matrices

from blender_primdiffusion.engine.picture import posed_humans
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.collect import collect_files
from blender_primdiffusion.scene.human import (
    MARK,
    VolumeWriteError,
    armature_of,
    folder_of,
    humans,
    humans_folder,
    person_file,
    volume_path,
)
from blender_primdiffusion.scene.missing import missing_files

ops = bpy.ops.primdiffusion
COUNT = 6
ODD = 'Ä ö\' "x" 100%s 年'


@pytest.fixture
def source(addon, tmp_path, monkeypatch):
    folder = tmp_path / "source"
    folder.mkdir()
    npz = synthetic_shape.write(folder / "human.npz", COUNT)
    monkeypatch.setenv("FAKE_HUMAN", str(npz))
    write_person(folder / "person.human.safetensors", synthetic_shape.arrays(COUNT)["betas"])
    return folder


def made(source, name="Anna"):
    person = build_human(bpy.context, source / "human.npz", name, [source / "person.human.safetensors"])
    rotations = synthetic.axis_angle(np.random.default_rng(3).normal(0, 0.5, (24, 3)))
    pose_from_joint_rotations(armature_of(person), rotations)
    bpy.context.view_layer.objects.active = armature_of(person)
    bpy.context.view_layer.update()
    return person


@pytest.fixture
def person(source):
    anna = made(source)
    bpy.ops.wm.save_mainfile()
    return anna


def named(name="Anna"):
    return bpy.data.collections[name]


def places(person) -> np.ndarray:
    bpy.context.view_layer.update()
    return evaluated_matrices(person)


def whole(person, where=None) -> bool:
    """Files, grids and the engine's idea of a person; and their volumes' places, where these are given."""
    volumes = {thing.data for thing in person.all_objects if thing.type == "VOLUME"}
    assert len([thing for thing in person.all_objects if thing.type == "VOLUME"]) == COUNT
    assert not [one.summary() for one in missing_files()]
    assert all(volume.grids.load() for volume in volumes)
    assert person_file(person).is_file()
    files = [one.file.resolve() for one in posed_humans(bpy.context.evaluated_depsgraph_get())]
    assert person_file(person).resolve() in files
    if where is not None:
        np.testing.assert_allclose(places(person), where, atol=1e-6)
    return True


def step(name: str) -> None:
    bpy.ops.ed.undo_push(message=name)


def test_undo_and_redo_across_generate_edit_reshape_and_delete(source, addon):
    step("empty")
    ops.generate(seed=7)
    generated = places(humans(addon.scene)[0])
    ops.vary(seed=12)
    ops.reshape(height=1.6)
    step("reshape")
    reshaped = places(humans(bpy.context.scene)[0])
    ops.delete_human()
    step("delete")
    assert not humans(bpy.context.scene)
    bpy.ops.ed.undo()
    assert whole(humans(bpy.context.scene)[0], reshaped)
    bpy.ops.ed.undo()
    assert whole(humans(bpy.context.scene)[0], generated)
    bpy.ops.ed.undo()
    person = humans(bpy.context.scene)[0]
    assert whole(person, generated)
    assert json.loads(person_file(person).read_bytes())["seed"] == 7
    bpy.ops.ed.undo()
    assert not humans(bpy.context.scene)
    for _ in range(3):
        bpy.ops.ed.redo()
    assert whole(humans(bpy.context.scene)[0], reshaped)


def test_a_human_generated_after_a_deletion_leaves_the_file_of_the_deleted(source, addon):
    step("empty")
    ops.generate(seed=7)
    ops.delete_human()
    step("delete")
    ops.generate(seed=9)
    assert json.loads(person_file(humans(bpy.context.scene)[0]).read_bytes())["seed"] == 9
    bpy.ops.ed.undo()
    bpy.ops.ed.undo()
    person = humans(bpy.context.scene)[0]
    assert whole(person)
    assert json.loads(person_file(person).read_bytes())["seed"] == 7


def test_saving_and_loading(person):
    where = places(person)
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert whole(named(), where)


def test_saved_under_another_name_elsewhere_and_then_collected(person, tmp_path):
    where, elsewhere = places(person), tmp_path / ODD
    elsewhere.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(elsewhere / "b.blend"))
    assert whole(named(), where)
    bpy.ops.wm.open_mainfile(filepath=str(elsewhere / "b.blend"))
    assert whole(named(), where)
    assert not (elsewhere / "b_humans").exists()
    assert ops.collect_files() == {"FINISHED"}
    bpy.ops.wm.save_mainfile()
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
    anna = made(source)
    where, berta = places(anna), made(source, "Berta")
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
    anna = made(source)
    crashed = tmp_path / "blender_a1b2c3" / "primdiffusion_humans"
    shutil.move(humans_folder(""), crashed)
    for volume in bpy.data.volumes:
        volume.filepath = str(crashed / "Anna" / volume_path(volume).name)
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


def test_appended_people_are_whole_and_can_be_edited_and_collected(person, tmp_path):
    where, other = places(person), tmp_path / "other"
    other.mkdir()
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(other / "film.blend"))
    bpy.ops.wm.append(directory=str(tmp_path / "shot.blend" / "Collection") + os.sep, filename="Anna")
    assert whole(named(), where)
    assert ops.vary(human="Anna", seed=13) == {"FINISHED"}
    assert whole(named(), where)
    assert ops.collect_files() == {"FINISHED"}
    assert person_file(named()).is_relative_to(other)
    bpy.ops.wm.save_mainfile()
    shutil.rmtree(tmp_path / "shot_humans")
    bpy.ops.wm.open_mainfile(filepath=str(other / "film.blend"))
    assert whole(named(), where)


def linked(tmp_path, folder="other"):
    (tmp_path / folder).mkdir()
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / folder / "film.blend"))
    with bpy.data.libraries.load(str(tmp_path / "shot.blend"), link=True, relative=True) as (_, wanted):
        wanted.collections = ["Anna"]
    bpy.context.scene.collection.children.link(wanted.collections[0])
    return wanted.collections[0]


def test_linked_people_are_whole_and_reject_edits(person, tmp_path):
    where = places(person)
    anna = linked(tmp_path)
    assert whole(anna, where)
    for operator in (ops.vary, ops.reset_shape, ops.delete_human, ops.duplicate_human):
        with pytest.raises(RuntimeError, match="linked"):
            operator()
    assert ops.collect_files() == {"FINISHED"}
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert whole(named(), where)


def test_linked_people_with_overrides_can_be_posed_and_made_local(person, tmp_path):
    anna = linked(tmp_path)
    override = anna.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    armature = armature_of(override)
    armature.pose.bones["head"].rotation_quaternion = (0.9, 0.1, 0.2, 0.1)
    armature.location.x = 3
    where = places(override)
    assert whole(override, where)
    with pytest.raises(RuntimeError, match="linked"):
        ops.vary(human=override.name)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    override = next(c for c in bpy.data.collections if MARK in c and c.library is None)
    assert whole(override, where)


def test_made_local(person, tmp_path):
    where = places(person)
    linked(tmp_path)
    bpy.ops.object.make_local(type="ALL")
    anna = named()
    assert whole(anna, where)


def test_blenders_own_duplicate_of_all_parts(person):
    where = places(person)
    for thing in list(person.all_objects):
        thing.hide_viewport = False
        thing.select_set(True)
    bpy.ops.object.duplicate()
    copies = [thing for thing in bpy.context.selected_objects if thing.type == "VOLUME"]
    assert len(copies) == COUNT
    (armature,) = {thing.parent for thing in copies}
    assert armature != armature_of(person) or len(copies) == COUNT
    assert all(thing.data.grids.load() for thing in copies)
    originals = [thing for thing in person.all_objects if thing.type == "VOLUME" and thing not in copies]
    bpy.context.view_layer.update()
    assert np.isfinite([list(row) for thing in originals for row in thing.matrix_world]).all()
    bpy.data.batch_remove([thing for thing in bpy.context.selected_objects])
    assert whole(person, where)


def test_our_duplicate_and_two_people(person):
    where = places(person)
    ops.duplicate_human()
    ops.vary(human="Anna.001", seed=14)
    assert whole(named(), where)
    assert whole(named("Anna.001"))
    assert person_file(named()) != person_file(named("Anna.001"))


@pytest.mark.parametrize("kind", ["LINK_COPY", "FULL_COPY"])
def test_copies_of_a_scene(person, kind):
    where, first = places(person), bpy.context.scene
    bpy.ops.scene.new(type=kind)
    (there,) = humans(bpy.context.scene)
    assert whole(there, where)
    assert (there == person) == (kind == "LINK_COPY")
    bpy.data.scenes.remove(bpy.context.scene)
    bpy.context.window.scene = first
    assert whole(named(), where)


def test_two_scenes_share_a_person(person):
    other = bpy.data.scenes.new("Other")
    other.collection.children.link(person)
    first = bpy.context.scene
    ops.vary(seed=14)
    for scene in (first, other):
        bpy.context.window.scene = scene
        assert whole(person)


def test_names_and_collections_of_parts_may_change(person):
    where = [list(row) for row in places(person)]
    person.name = "Wer?"
    order = sorted((thing for thing in person.all_objects if thing.type == "VOLUME"), key=lambda thing: thing.name)
    for number, thing in enumerate(order):
        thing.name = f"x{number}"
    armature_of(person).name = "Rig"
    bpy.ops.wm.save_mainfile()
    assert whole(named("Wer?"), where)
    ops.vary(seed=14)
    assert whole(named("Wer?"), where)


def test_the_armature_turned_and_scaled_in_a_scene_of_centimetres(person):
    bpy.context.scene.unit_settings.scale_length = 0.01
    bpy.context.scene.render.fps = 60
    armature = armature_of(person)
    before, old = places(person), np.array(armature.matrix_world)
    armature.scale, armature.rotation_euler = (100, 100, 100), (0.3, 0.2, 1.0)
    bpy.context.view_layer.update()
    moved = np.array(armature.matrix_world) @ np.linalg.inv(old)
    np.testing.assert_allclose(places(person), moved @ before, atol=1e-4)
    assert whole(person)


def test_purging_and_packing_take_nothing_away(person):
    where = places(person)
    bpy.ops.outliner.orphans_purge(do_recursive=True)
    bpy.ops.file.pack_all()
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert whole(named(), where)


def test_a_full_disk_while_saving_or_collecting_leaves_people_as_they_are(person, tmp_path, monkeypatch):
    import errno

    from blender_primdiffusion.scene import human

    where, other = places(person), tmp_path / "other"
    other.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(other / "b.blend"))
    before = {volume.name: volume.filepath for volume in bpy.data.volumes}
    copy, copied = shutil.copyfile, []

    def full(source, destination):
        if len(copied) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        copied.append(copy(source, destination))

    monkeypatch.setattr(human.shutil, "copyfile", full)
    with pytest.raises(VolumeWriteError, match="free space"):
        collect_files()
    copied.clear()
    with pytest.raises(RuntimeError, match="No space left"):
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
    with pytest.raises(RuntimeError, match="write permission"):
        ops.collect_files()
    assert whole(named())


def test_a_path_as_long_as_blender_takes(source, tmp_path):
    folder = tmp_path
    while len(str(folder)) < 780:
        folder /= "langer_name_" * 8
    folder.mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "a.blend"))
    made(source)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(folder / "a.blend"))
    assert whole(named())


def test_memory_of_deleted_people_is_given_back_and_undo_shows_them_again(person):
    where = places(person)
    step("before")
    ops.delete_human()
    step("delete")
    bpy.ops.ed.undo()
    assert whole(named(), where)
    ops.release_memory()
    assert whole(named(), where)


def test_edits_do_not_pile_up_grids(source, monkeypatch):
    npz = synthetic_shape.write(source / "large.npz", 64)
    monkeypatch.setenv("FAKE_HUMAN", str(npz))
    build_human(bpy.context, npz, "Anna", [source / "person.human.safetensors"])
    bpy.context.view_layer.update()
    ops.vary(seed=11)
    before = psutil.Process().memory_info().rss
    for seed in (12, 13, 14):
        ops.vary(seed=seed)
        bpy.context.view_layer.update()
    grown = (psutil.Process().memory_info().rss - before) / 1e6
    assert grown < 60, f"three edits of 64 grids of 0.9 MB: {grown:.0f} MB more"
