"""A person reshaped in the scene: bones, mesh and volumes go where the new body has them, the pose stays."""

import json

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from oracle import TOLERANCE_M, blended_vertices, evaluated_matrices, raised, surface_frames, world_from_model
from scene_stage import replace

from blender_primdiffusion.scene.armature import keyframe_poses, pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.convention import points_to_blender
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import BETAS, MARK, body_of
from blender_primdiffusion.scene.shape import betas_of, generated_betas, has_custom_shape

COUNT = 12
SHAPE = np.array([2.0, -1.5, 1, 0, 0.5, 0, 0, -2, 0, 1])


@pytest.fixture
def person(saved_scene, tmp_path):
    return build_human(saved_scene, synthetic_shape.write(tmp_path / "human"))


def at(betas: np.ndarray) -> dict:
    return synthetic_shape.at(synthetic_shape.arrays(COUNT), np.asarray(betas))


def heads(person) -> np.ndarray:
    """Rest joints [24, 3] in the armature's space."""
    return np.array([person.data.bones[name].head_local for name in synthetic.NAMES])


def standing(points, body) -> np.ndarray:
    """Points [N, 3] of the body model, y up, in the space of an armature that has its soles at its origin, z up."""
    return points_to_blender(points) + raised(body["vertices"])[:3, 3]


def lowest(person) -> float:
    armature = person
    return min((armature.matrix_world @ vertex.co).z for vertex in body_of(person).data.vertices)


def test_bones_mesh_and_volumes_of_a_posed_person_are_those_of_the_new_body_in_the_same_pose(person, saved_scene):
    rng = np.random.default_rng(3)
    rotations, translation = synthetic.axis_angle(rng.normal(0, 0.6, (24, 3))), rng.normal(0, 0.5, 3)
    pose_from_joint_rotations(person, rotations, translation)
    assert reshape(person, SHAPE) == ""
    np.testing.assert_allclose(betas_of(person), SHAPE)
    body_of(person).hide_viewport = False
    saved_scene.view_layer.update()
    wanted = at(SHAPE)
    np.testing.assert_allclose(heads(person), standing(wanted["joints"], wanted), atol=TOLERANCE_M)
    matrix = world_from_model(person, wanted["vertices"])
    corners = np.array([[x, y, z, 1] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
    difference = evaluated_matrices(person) - matrix @ surface_frames(wanted, rotations, translation)
    assert np.abs(difference @ corners.T)[:, :3].max() < TOLERANCE_M
    body = body_of(person).evaluated_get(bpy.context.evaluated_depsgraph_get())
    vertices = np.array([vertex.co for vertex in body.data.vertices]) - raised(wanted["vertices"])[:3, 3]
    np.testing.assert_allclose(vertices, blended_vertices(wanted, rotations, translation), atol=TOLERANCE_M)


def test_an_animation_turns_the_joints_as_before(person, saved_scene):
    rotations = synthetic.axis_angle(np.random.default_rng(1).normal(0, 0.5, (2, 24, 3)))
    keyframe_poses(person, np.array([1, 5]), rotations, np.zeros((2, 3)))
    reshape(person, SHAPE)
    saved_scene.scene.frame_set(5)
    world = world_from_model(person, at(SHAPE)["vertices"])
    expected = world @ surface_frames(at(SHAPE), rotations[1], np.zeros(3))
    np.testing.assert_allclose(evaluated_matrices(person), expected, atol=2 * TOLERANCE_M)


@pytest.mark.any_blender
def test_changing_the_shape_and_back_is_no_change(person, saved_scene):
    before = heads(person), betas_of(person)
    reshape(person, SHAPE)
    reshape(person, before[1])
    np.testing.assert_allclose(heads(person), before[0], atol=1e-6)
    assert not has_custom_shape(person)


@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_soles_on_the_floor_stay_there(person, saved_scene, scale):
    person.scale, person.rotation_euler.z, person.location.x = (scale,) * 3, 1.0, 4.0
    reshape(person, SHAPE)
    saved_scene.view_layer.update()
    assert lowest(person) == pytest.approx(0, abs=1e-5)


def test_mode_selection_scenes_objects_and_files_stay_as_they_were(person, saved_scene, tmp_path):
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    armature = person
    saved_scene.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="POSE")
    before = [obj.name for kind in (bpy.data.objects, bpy.data.scenes, bpy.data.armatures) for obj in kind]
    reshape(person, SHAPE)
    assert armature.mode == "POSE"
    assert saved_scene.view_layer.objects.active == armature
    assert [obj.name for kind in (bpy.data.objects, bpy.data.scenes, bpy.data.armatures) for obj in kind] == before
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == files


def in_edit_mode(context, person):
    context.view_layer.objects.active = person
    bpy.ops.object.mode_set(mode="EDIT")


def with_renamed_bone(_context, person):
    person.data.bones["left_knee"].name = "knee.L"


REFUSED = {
    r"'Human' is in Edit Mode: leave it": (in_edit_mode, SHAPE),
    r"no bone 'left_knee'.*name again": (with_renamed_bone, SHAPE),
    r"a shape is 10 numbers from -5 to 5, not": (lambda *_: None, SHAPE * 4),
    r"a shape is 10 numbers .*, not \[1.0\]": (lambda *_: None, [1.0]),
}


@pytest.mark.any_blender
@pytest.mark.parametrize("sentence", REFUSED)
def test_what_cannot_be_reshaped_is_rejected_untouched(person, saved_scene, sentence):
    change, betas = REFUSED[sentence]
    change(saved_scene, person)
    before = list(person[BETAS])
    with pytest.raises(ValueError, match=sentence):
        reshape(person, betas)
    assert list(person[BETAS]) == before
    if person.mode == "EDIT":
        bpy.ops.object.mode_set(mode="OBJECT")


@pytest.mark.any_blender
def test_a_mesh_changed_by_hand_keeps_its_shape_and_is_named(person):
    body_of(person).shape_key_add(name="Basis")
    assert "'Human_body' was changed by hand" in reshape(person, SHAPE)
    np.testing.assert_allclose(heads(person), standing(at(SHAPE)["joints"], at(SHAPE)), atol=TOLERANCE_M)


@pytest.mark.any_blender
def test_without_body_mesh_the_rest_still_follows(person):
    bpy.data.objects.remove(body_of(person))
    assert reshape(person, SHAPE) == ""
    np.testing.assert_allclose(heads(person), standing(at(SHAPE)["joints"], at(SHAPE)), atol=TOLERANCE_M)


def edited_file(tmp_path, betas):
    return synthetic.save(tmp_path / "edited", {**at(betas), "meta": np.array(json.dumps({"seed": 9}))})


def test_a_custom_shape_survives_an_edit_that_changes_the_shape(person, tmp_path):
    reshape(person, SHAPE)
    done = replace(person, edited_file(tmp_path, np.ones(10)))
    assert not done.reshaped
    np.testing.assert_allclose(betas_of(person), SHAPE)
    np.testing.assert_allclose(heads(person), standing(at(SHAPE)["joints"], at(SHAPE)), atol=TOLERANCE_M)
    assert json.loads(person[MARK])["seed"] == 9
    np.testing.assert_allclose(generated_betas(person), 1)
    reshape(person, generated_betas(person))
    assert not has_custom_shape(person)


def sizes(matrices) -> np.ndarray:
    """How many times as large as in their files volumes are along their axes [K, 3]."""
    return np.linalg.norm(np.asarray(matrices)[:, :3, :3], axis=1)


def test_volumes_grow_with_half_of_the_surface_s_stretch(person):
    reshape(person, SHAPE)
    wanted = at(SHAPE)["growth"]
    assert wanted.max() > 1.01
    np.testing.assert_allclose(sizes(evaluated_matrices(person)), wanted, rtol=1e-5)
    reshape(person, generated_betas(person))
    np.testing.assert_allclose(sizes(evaluated_matrices(person)), 1, rtol=1e-5)


@pytest.mark.any_blender
def test_volumes_of_an_edited_person_grow_from_the_edited_one_s_body(person, saved_scene, tmp_path):
    reshape(person, SHAPE)
    replace(person, edited_file(tmp_path, np.ones(10)))
    saved_scene.view_layer.update()
    edited = at(np.ones(10))
    wanted = at(SHAPE)["growth"] / edited["growth"]
    np.testing.assert_allclose(sizes(evaluated_matrices(person)), wanted, rtol=1e-5)
    reshape(person, np.ones(10))
    saved_scene.view_layer.update()
    np.testing.assert_allclose(sizes(evaluated_matrices(person)), 1, rtol=1e-5)
