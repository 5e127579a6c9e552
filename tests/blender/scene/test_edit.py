"""A person replaced in place: what an edit left alone is untouched, and undo finds every file it needs."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from human_files import folder_of, person_file
from oracle import TOLERANCE_M, blended_vertices, evaluated_matrices, raised, surface_frames, world_from_model
from scene_stage import replace
from support import tensor_files

from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import BETAS, MARK, body_of, human_of, parts_of, state_of
from blender_primdiffusion.scene.volume_nodes import volumes_of

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


def transforms(collection) -> dict[str, list]:
    volumes = evaluated_matrices(collection).round(5).tolist()
    places = {o.name: [list(row) for row in o.matrix_world] for o in parts_of(collection)}
    return {**places, "volumes": volumes}


@pytest.fixture
def person(saved_scene, tmp_path):
    collection = build_human(saved_scene, synthetic_shape.write(tmp_path / "human", COUNT))
    pose_from_joint_rotations(collection, synthetic.axis_angle(np.random.default_rng(3).normal(0, 0.5, (24, 3))))
    collection.location.x = 2.0
    return collection


@pytest.mark.any_blender
def test_an_edit_has_files_of_its_own_and_leaves_those_before(person, saved_scene, tmp_path):
    places = transforms(person)
    files = {path: path.stat().st_mtime_ns for path in folder_of(person).iterdir()}
    before, unedited = folder_of(person), state_of(person)
    done = replace(person, redyed(tmp_path, 3, 7))
    edited = state_of(person)
    assert folder_of(person) != before
    assert (done.reshaped, done.warning) == (False, "")
    assert transforms(person) == places
    assert {path: path.stat().st_mtime_ns for path in files} == files
    assert {path.name for path in files} == {path.name for path in folder_of(person).iterdir()}
    assert not first(person)
    assert json.loads(person[MARK])["edited"] == [3, 7]
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    assert state_of(person) == edited != unedited


def test_other_betas_move_bones_mesh_and_volumes_and_keep_the_pose(person, saved_scene, tmp_path):
    rotations = synthetic.axis_angle(np.random.default_rng(3).normal(0, 0.5, (24, 3)))
    before = [list(bone.rotation_quaternion) for bone in person.pose.bones]
    objects = {o.name for o in bpy.data.objects}
    saved_scene.view_layer.objects.active = body_of(person)
    done = replace(person, reshaped(tmp_path, 3))
    assert done.reshaped
    assert {o.name for o in bpy.data.objects} == objects
    assert saved_scene.view_layer.objects.active == body_of(person)
    armature = person
    np.testing.assert_allclose([list(bone.rotation_quaternion) for bone in armature.pose.bones], before, atol=1e-6)
    arrays = edited_shape()
    body_of(person).hide_viewport = False  # hidden things are not evaluated
    bpy.context.view_layer.update()
    expected = world_from_model(armature, arrays["vertices"]) @ surface_frames(arrays, rotations, np.zeros(3))
    corners = np.array([[x, y, z, 1] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
    assert np.abs((evaluated_matrices(person) - expected) @ corners.T)[:, :3].max() < TOLERANCE_M
    body = body_of(person).evaluated_get(bpy.context.evaluated_depsgraph_get())
    vertices = np.array([vertex.co for vertex in body.data.vertices]) - raised(arrays["vertices"])[:3, 3]
    np.testing.assert_allclose(vertices, blended_vertices(arrays, rotations, np.zeros(3)), atol=2e-5)
    np.testing.assert_allclose(list(armature[BETAS]), arrays["betas"], atol=1e-6)


def test_a_duplicate_that_shares_data_is_not_edited_with_the_original(person, saved_scene, tmp_path):
    twin = person.copy()
    saved_scene.scene.collection.objects.link(twin)
    for obj in person.children:
        copy = obj.copy()
        copy.parent = twin
        saved_scene.scene.collection.objects.link(copy)
    bones = [list(bone.head_local) for bone in twin.data.bones]
    cells = volumes_of(twin).data
    replace(person, reshaped(tmp_path, 3))
    assert [list(bone.head_local) for bone in twin.data.bones] == bones
    assert volumes_of(twin).data == cells != volumes_of(person).data
    assert first(twin)


@pytest.mark.any_blender
def test_every_part_of_a_human_leads_to_it_and_other_objects_do_not(person, saved_scene):
    hat = bpy.data.objects.new("hat", None)
    hat.parent = person
    cube = bpy.data.objects.new("cube", None)
    for obj in (hat, cube):
        saved_scene.scene.collection.objects.link(obj)
    assert {human_of(obj) for obj in [*parts_of(person), hat]} == {person}
    assert human_of(cube) is None
    assert human_of(None) is None
