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
from support.errors import refused

from blender_primdiffusion.scene.armature import keyframe_poses, pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.convention import points_to_blender
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import BETAS, MARK, body_of, human_of, parts_of, state_of
from blender_primdiffusion.scene.shape import betas_of, generated_betas, has_custom_shape
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


SHAPE = np.array([2.0, -1.5, 1, 0, 0.5, 0, 0, -2, 0, 1])


@pytest.fixture
def anna(saved_scene, tmp_path):
    return build_human(saved_scene, synthetic_shape.write(tmp_path / "human"))


def at(betas: np.ndarray) -> dict:
    return synthetic_shape.at(synthetic_shape.arrays(COUNT), np.asarray(betas))


def heads(anna) -> np.ndarray:
    """Rest joints [24, 3] in the armature's space."""
    return np.array([anna.data.bones[name].head_local for name in synthetic.NAMES])


def standing(points, body) -> np.ndarray:
    """Points [N, 3] of the body model, y up, in the space of an armature that has its soles at its origin, z up."""
    return points_to_blender(points) + raised(body["vertices"])[:3, 3]


def lowest(anna) -> float:
    armature = anna
    return min((armature.matrix_world @ vertex.co).z for vertex in body_of(anna).data.vertices)


def test_bones_mesh_and_volumes_of_a_posed_person_are_those_of_the_new_body_in_the_same_pose(anna, saved_scene):
    rng = np.random.default_rng(3)
    rotations, translation = synthetic.axis_angle(rng.normal(0, 0.6, (24, 3))), rng.normal(0, 0.5, 3)
    pose_from_joint_rotations(anna, rotations, translation)
    assert reshape(anna, SHAPE) == ""
    np.testing.assert_allclose(betas_of(anna), SHAPE)
    body_of(anna).hide_viewport = False
    saved_scene.view_layer.update()
    wanted = at(SHAPE)
    np.testing.assert_allclose(heads(anna), standing(wanted["joints"], wanted), atol=TOLERANCE_M)
    matrix = world_from_model(anna, wanted["vertices"])
    corners = np.array([[x, y, z, 1] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
    difference = evaluated_matrices(anna) - matrix @ surface_frames(wanted, rotations, translation)
    assert np.abs(difference @ corners.T)[:, :3].max() < TOLERANCE_M
    body = body_of(anna).evaluated_get(bpy.context.evaluated_depsgraph_get())
    vertices = np.array([vertex.co for vertex in body.data.vertices]) - raised(wanted["vertices"])[:3, 3]
    np.testing.assert_allclose(vertices, blended_vertices(wanted, rotations, translation), atol=TOLERANCE_M)


def test_an_animation_turns_the_joints_as_before(anna, saved_scene):
    rotations = synthetic.axis_angle(np.random.default_rng(1).normal(0, 0.5, (2, 24, 3)))
    keyframe_poses(anna, np.array([1, 5]), rotations, np.zeros((2, 3)))
    reshape(anna, SHAPE)
    saved_scene.scene.frame_set(5)
    world = world_from_model(anna, at(SHAPE)["vertices"])
    expected = world @ surface_frames(at(SHAPE), rotations[1], np.zeros(3))
    np.testing.assert_allclose(evaluated_matrices(anna), expected, atol=2 * TOLERANCE_M)


@pytest.mark.any_blender
def test_changing_the_shape_and_back_is_no_change(anna, saved_scene):
    before = heads(anna), betas_of(anna)
    reshape(anna, SHAPE)
    reshape(anna, before[1])
    np.testing.assert_allclose(heads(anna), before[0], atol=1e-6)
    assert not has_custom_shape(anna)


@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_soles_on_the_floor_stay_there(anna, saved_scene, scale):
    anna.scale, anna.rotation_euler.z, anna.location.x = (scale,) * 3, 1.0, 4.0
    reshape(anna, SHAPE)
    saved_scene.view_layer.update()
    assert lowest(anna) == pytest.approx(0, abs=1e-5)


def test_mode_selection_scenes_objects_and_files_stay_as_they_were(anna, saved_scene, tmp_path):
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    armature = anna
    saved_scene.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="POSE")
    before = [obj.name for kind in (bpy.data.objects, bpy.data.scenes, bpy.data.armatures) for obj in kind]
    reshape(anna, SHAPE)
    assert armature.mode == "POSE"
    assert saved_scene.view_layer.objects.active == armature
    assert [obj.name for kind in (bpy.data.objects, bpy.data.scenes, bpy.data.armatures) for obj in kind] == before
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == files


def in_edit_mode(context, anna):
    context.view_layer.objects.active = anna
    bpy.ops.object.mode_set(mode="EDIT")


REFUSED = {
    "'Human' is in Edit Mode: leave it": (in_edit_mode, SHAPE),
    "no bone 'left_knee'": (lambda _, anna: setattr(anna.data.bones["left_knee"], "name", "knee.L"), SHAPE),
    "a shape is 10 numbers from -5 to 5, not": (lambda *_: None, SHAPE * 4),
    ", not [1.0]": (lambda *_: None, [1.0]),
}


@pytest.mark.any_blender
@pytest.mark.parametrize("sentence", REFUSED)
def test_what_cannot_be_reshaped_is_rejected_untouched(anna, saved_scene, sentence):
    change, betas = REFUSED[sentence]
    change(saved_scene, anna)
    before = list(anna[BETAS])
    with refused(ValueError, sentence):
        reshape(anna, betas)
    assert list(anna[BETAS]) == before
    if anna.mode == "EDIT":
        bpy.ops.object.mode_set(mode="OBJECT")


@pytest.mark.any_blender
def test_a_mesh_changed_by_hand_keeps_its_shape_and_is_named(anna):
    body_of(anna).shape_key_add(name="Basis")
    assert "'Human_body' was changed by hand" in reshape(anna, SHAPE)
    np.testing.assert_allclose(heads(anna), standing(at(SHAPE)["joints"], at(SHAPE)), atol=TOLERANCE_M)


@pytest.mark.any_blender
def test_without_body_mesh_the_rest_still_follows(anna):
    bpy.data.objects.remove(body_of(anna))
    assert reshape(anna, SHAPE) == ""
    np.testing.assert_allclose(heads(anna), standing(at(SHAPE)["joints"], at(SHAPE)), atol=TOLERANCE_M)


def edited_file(tmp_path, betas):
    return synthetic.save(tmp_path / "edited", {**at(betas), "meta": np.array(json.dumps({"seed": 9}))})


def test_a_custom_shape_survives_an_edit_that_changes_the_shape(anna, tmp_path):
    reshape(anna, SHAPE)
    done = replace(anna, edited_file(tmp_path, np.ones(10)))
    assert not done.reshaped
    np.testing.assert_allclose(betas_of(anna), SHAPE)
    np.testing.assert_allclose(heads(anna), standing(at(SHAPE)["joints"], at(SHAPE)), atol=TOLERANCE_M)
    assert json.loads(anna[MARK])["seed"] == 9
    np.testing.assert_allclose(generated_betas(anna), 1)
    reshape(anna, generated_betas(anna))
    assert not has_custom_shape(anna)


def sizes(matrices) -> np.ndarray:
    """How many times as large as in their files volumes are along their axes [K, 3]."""
    return np.linalg.norm(np.asarray(matrices)[:, :3, :3], axis=1)


def test_volumes_grow_with_half_of_the_surface_s_stretch(anna):
    reshape(anna, SHAPE)
    wanted = at(SHAPE)["growth"]
    assert wanted.max() > 1.01
    np.testing.assert_allclose(sizes(evaluated_matrices(anna)), wanted, rtol=1e-5)
    reshape(anna, generated_betas(anna))
    np.testing.assert_allclose(sizes(evaluated_matrices(anna)), 1, rtol=1e-5)


@pytest.mark.any_blender
def test_volumes_of_an_edited_person_grow_from_the_edited_one_s_body(anna, saved_scene, tmp_path):
    reshape(anna, SHAPE)
    replace(anna, edited_file(tmp_path, np.ones(10)))
    saved_scene.view_layer.update()
    edited = at(np.ones(10))
    wanted = at(SHAPE)["growth"] / edited["growth"]
    np.testing.assert_allclose(sizes(evaluated_matrices(anna)), wanted, rtol=1e-5)
    reshape(anna, np.ones(10))
    saved_scene.view_layer.update()
    np.testing.assert_allclose(sizes(evaluated_matrices(anna)), 1, rtol=1e-5)
