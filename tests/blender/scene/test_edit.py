"""A person replaced in place: what an edit left alone is untouched, and undo finds every file it needs."""

from __future__ import annotations

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from blender_primdiffusion.formats.regular_files import FileError
from oracle import TOLERANCE_M, blended_frames, blended_vertices, evaluated_matrices, raised, world_from_model
from scene_stage import replace
from support import tensor_files
from support.errors import refused

from blender_primdiffusion.scene import volumes
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.collect import collect_before_saving, unused
from blender_primdiffusion.scene.human import (
    BETAS,
    MARK,
    armature_of,
    body_of,
    folder_of,
    human_of,
    humans,
    person_file,
    state_folder,
    state_of,
)

pytestmark = pytest.mark.usefixtures("volumes_shown")

COUNT = 12


def redyed(tmp_path, *which: int, seed: int = 0, **changes) -> Path:
    """The file of a person of whom some primitives have another colour."""
    rgb = synthetic_shape.arrays(COUNT, seed)["rgb"].copy()
    rgb[list(which)] = 1 - rgb[list(which)]
    meta = np.array(json.dumps({"seed": seed, "edited": list(which), "steps": 5}))
    return synthetic_shape.write(tmp_path / "edited", COUNT, seed, rgb=rgb, meta=meta, **changes)


def edited_shape() -> dict[str, np.ndarray]:
    before = synthetic_shape.arrays(COUNT)
    arrays = synthetic_shape.at(before, before["betas"] + 1)
    del arrays["growth"]  # boxes of a generated shape have their own sizes
    return arrays


def reshaped(tmp_path, *which: int) -> Path:
    return redyed(tmp_path, *which, betas=edited_shape()["betas"])


def first(person) -> bool:
    """Whether the human's file is that of the person before the edit."""
    return "edited" not in tensor_files.read_tensors(person_file(person))[1]["provenance"]


def paths(collection) -> dict[str, str]:
    return {o.name: o.data.filepath for o in collection.all_objects if o.type == "VOLUME"}


def transforms(collection) -> dict[str, list]:
    bpy.context.view_layer.update()
    return {o.name: [list(row) for row in o.matrix_world] for o in collection.all_objects}


@pytest.fixture
def person(saved_scene, tmp_path):
    collection = build_human(saved_scene, synthetic_shape.write(tmp_path / "human", COUNT))
    pose_from_joint_rotations(
        armature_of(collection), synthetic.axis_angle(np.random.default_rng(3).normal(0, 0.5, (24, 3)))
    )
    armature_of(collection).location.x = 2.0
    return collection


def test_an_edit_is_a_new_folder_and_leaves_the_files_of_the_state_before(person, saved_scene, tmp_path):
    places = transforms(person)
    files = {path: path.stat().st_mtime_ns for path in state_folder(person).iterdir()}
    done = replace(person, redyed(tmp_path, 3, 7))
    assert state_folder(person) == folder_of(person) / "0002"
    assert (done.reshaped, done.warning) == (False, "")
    assert transforms(person) == places
    assert {path: path.stat().st_mtime_ns for path in files} == files
    assert {path.name for path in files} == {path.name for path in state_folder(person).iterdir()}
    assert all(volume.grids.load() for volume in bpy.data.volumes)
    assert not first(person)
    assert json.loads(person[MARK])["edited"] == [3, 7]


def test_the_state_is_told_apart_by_what_it_holds_not_by_its_folder(person, saved_scene, tmp_path):
    before = state_of(person)
    replace(person, redyed(tmp_path, 3))
    edited = state_of(person)
    assert edited != before
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    assert state_of(person) == edited


def test_undo_and_redo_bring_back_volumes_and_the_persons_file(person, saved_scene, tmp_path):
    bpy.ops.ed.undo_push(message="before")
    before = paths(person)
    replace(person, redyed(tmp_path, 3))
    after = paths(person)
    bpy.ops.ed.undo_push(message="edit")
    bpy.ops.ed.undo()
    (person,) = humans(bpy.context.scene)
    assert paths(person) == before
    assert first(person)
    assert all(volume.grids.load() for volume in bpy.data.volumes)
    bpy.ops.ed.redo()
    (person,) = humans(bpy.context.scene)
    assert paths(person) == after
    assert not first(person)


def test_other_betas_move_bones_mesh_and_volumes_and_keep_the_pose(person, saved_scene, tmp_path):
    rotations = synthetic.axis_angle(np.random.default_rng(3).normal(0, 0.5, (24, 3)))
    before = [list(bone.rotation_quaternion) for bone in armature_of(person).pose.bones]
    objects = {o.name for o in bpy.data.objects}
    saved_scene.view_layer.objects.active = body_of(person)
    done = replace(person, reshaped(tmp_path, 3))
    assert done.reshaped
    assert {o.name for o in bpy.data.objects} == objects
    assert saved_scene.view_layer.objects.active == body_of(person)
    armature = armature_of(person)
    np.testing.assert_allclose([list(bone.rotation_quaternion) for bone in armature.pose.bones], before, atol=1e-6)
    arrays = edited_shape()
    body_of(person).hide_viewport = False  # hidden things are not evaluated
    bpy.context.view_layer.update()
    expected = world_from_model(armature, arrays["vertices"]) @ blended_frames(arrays, rotations, np.zeros(3))
    corners = np.array([[x, y, z, 1] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
    assert np.abs((evaluated_matrices(person) - expected) @ corners.T)[:, :3].max() < TOLERANCE_M
    body = body_of(person).evaluated_get(bpy.context.evaluated_depsgraph_get())
    vertices = np.array([vertex.co for vertex in body.data.vertices]) - raised(arrays["vertices"])[:3, 3]
    np.testing.assert_allclose(vertices, blended_vertices(arrays, rotations, np.zeros(3)), atol=2e-5)
    np.testing.assert_allclose(list(armature[BETAS]), arrays["betas"], atol=1e-6)


def test_undo_takes_another_shape_back(person, saved_scene, tmp_path):
    bpy.ops.ed.undo_push(message="before")
    places = transforms(person)
    replace(person, reshaped(tmp_path))
    assert transforms(person) != places
    bpy.ops.ed.undo_push(message="edit")
    bpy.ops.ed.undo()
    assert transforms(humans(bpy.context.scene)[0]) == places


def test_a_shape_the_user_chose_stays_while_the_betas_do(person, saved_scene, tmp_path):
    armature_of(person)[BETAS] = [2.0] * 10
    replace(person, redyed(tmp_path, 3))
    assert list(armature_of(person)[BETAS]) == [2.0] * 10


def test_a_mesh_changed_by_hand_keeps_its_shape_and_is_named(person, saved_scene, tmp_path):
    body_of(person).shape_key_add(name="Basis")
    assert "changed by hand" in replace(person, reshaped(tmp_path)).warning


def test_what_was_renamed_moved_or_deleted_by_hand_stays_so(person, saved_scene, tmp_path):
    objects = sorted((o for o in person.all_objects if o.type == "VOLUME"), key=lambda o: o.name)
    objects[3].name = "brooch"
    objects[4].location.z += 1
    height = objects[4].location.z
    bpy.data.objects.remove(objects[5])
    replace(person, redyed(tmp_path, 3, 4, 5))
    assert sum(obj.type == "VOLUME" for obj in person.all_objects) == COUNT - 1
    assert bpy.data.objects["Human_prim_0004"].location.z == height
    assert "Human_prim_0005" not in bpy.data.objects


def test_a_duplicate_that_shares_volumes_is_not_edited_with_the_original(person, saved_scene, tmp_path):
    twin = bpy.data.collections.new("Twin")
    saved_scene.scene.collection.children.link(twin)
    twin[MARK] = person[MARK]
    for obj in list(person.all_objects):
        twin.objects.link(obj.copy())
    before = {o.name: o.data.filepath for o in twin.objects if o.type == "VOLUME"}
    bones = [list(bone.head_local) for bone in armature_of(twin).data.bones]
    replace(person, reshaped(tmp_path, 3))
    assert {o.name: o.data.filepath for o in twin.objects if o.type == "VOLUME"} == before
    assert [list(bone.head_local) for bone in armature_of(twin).data.bones] == bones
    assert first(twin)


def test_a_damaged_result_leaves_scene_and_disk_as_they_were(person, saved_scene, tmp_path):
    bad = tmp_path / "bad.human"
    bad.write_bytes(b"PK no more")
    before, files = paths(person), sorted(tmp_path.rglob("*.*"))
    with refused(ValueError, "bad.human"):
        replace(person, bad)
    assert paths(person) == before
    assert sorted(tmp_path.rglob("*.*")) == files


def test_a_full_disk_leaves_scene_and_disk_as_they_were(person, saved_scene, tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left on device")

    edited = redyed(tmp_path, 3)
    before, files = paths(person), sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(volumes, "write_vdb", full)
    with refused(FileError):
        replace(person, edited)
    assert paths(person) == before
    assert sorted(tmp_path.rglob("*")) == files


def test_after_saving_under_another_name_an_edit_goes_to_the_new_folder(person, saved_scene, tmp_path):
    before = state_folder(person)
    files = sorted(before.parent.rglob("*"))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    replace(person, redyed(tmp_path, 3))
    assert sorted(before.parent.rglob("*")) == files
    assert all(path.startswith("//second_humans/Human/") for path in paths(person).values())
    assert person_file(person).is_relative_to(tmp_path / "second_humans" / "Human")
    assert all(volume.grids.load() for volume in bpy.data.volumes)


def test_an_edit_before_the_first_save_is_collected_without_the_states_before_it(empty_scene, tmp_path):
    person = build_human(empty_scene, synthetic_shape.write(tmp_path / "human", COUNT))
    replace(person, redyed(tmp_path, 3))
    bpy.app.handlers.save_pre.append(collect_before_saving)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    finally:
        bpy.app.handlers.save_pre.remove(collect_before_saving)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "shot.blend"))
    (person,) = humans(bpy.context.scene)
    assert not first(person)
    assert list((tmp_path / "shot_humans" / "Human").iterdir()) == [state_folder(person)]
    assert len(list(state_folder(person).iterdir())) == COUNT + 2
    assert all(volume.grids.load() for volume in bpy.data.volumes)


def test_files_of_earlier_states_are_unused_and_those_shown_are_not(person, saved_scene, tmp_path):
    humans_folder, before = tmp_path / "shot_humans", state_folder(person)
    assert unused(humans_folder) == []
    (before / "notes.txt").write_text("mine")
    replace(person, redyed(tmp_path, 3))
    assert unused(humans_folder) == sorted(path for path in before.iterdir() if path.name != "notes.txt")
    assert unused(tmp_path / "nowhere") == []


def test_every_part_of_a_human_leads_to_it_and_other_objects_do_not(person, saved_scene):
    hat = bpy.data.objects.new("hat", None)
    hat.parent = armature_of(person)
    cube = bpy.data.objects.new("cube", None)
    for obj in (hat, cube):
        saved_scene.scene.collection.objects.link(obj)
    assert {human_of(obj, saved_scene.scene) for obj in [*person.all_objects, hat]} == {person}
    assert human_of(cube, saved_scene.scene) is None
    assert human_of(None, saved_scene.scene) is None
