"""The skeleton: SMPL's bones, and poses that are SMPL's whatever the bones' own axes are."""

import bpy
import numpy as np
import pytest
import synthetic
from blender_primdiffusion.formats.poses.rotation import matrix_to_quaternion
from oracle import TOLERANCE_M, Z_UP, blended_vertices
from support.errors import refused

from blender_primdiffusion.scene.armature import build_armature, keyframe_poses, pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_body_mesh
from blender_primdiffusion.scene.convention import (
    continuous_quaternions,
    points_to_blender,
    rotations_to_blender,
)


@pytest.fixture
def armature(empty_scene):
    made = build_armature("Human", points_to_blender(synthetic.joints()))
    empty_scene.scene.collection.objects.link(made)
    return made


def joint_matrices(armature: bpy.types.Object) -> np.ndarray:
    """Bone matrices times their rest's inverse [24, 4, 4]: skinning transforms in the armature's space."""
    bpy.context.view_layer.update()
    pose = armature.pose.bones
    return np.array([np.array(pose[n].matrix @ pose[n].bone.matrix_local.inverted()) for n in synthetic.NAMES])


def smpl_matrices(rotations: np.ndarray, translation: np.ndarray) -> np.ndarray:
    return Z_UP @ synthetic.skinning(synthetic.joints(), rotations, translation) @ Z_UP.T


@pytest.mark.any_blender
def test_a_person_facing_plus_z_with_y_up_faces_minus_y_with_z_up():
    up, forward, left = np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    assert points_to_blender(up).tolist() == [0, 0, 1]
    assert points_to_blender(forward).tolist() == [0, -1, 0]
    assert points_to_blender(left).tolist() == [1, 0, 0]


@pytest.mark.any_blender
def test_turning_points_and_turning_rotations_agree():
    rotation = synthetic.random_rotations(np.random.default_rng(0), 1)[0]
    point = np.array([0.3, -0.2, 0.9])
    moved = points_to_blender(rotation @ point)
    np.testing.assert_allclose(moved, rotations_to_blender(rotation) @ points_to_blender(point), atol=1e-15)


def test_bones_have_smpl_names_parents_and_heads_at_the_joints(armature):
    bones = armature.data.bones
    assert sorted(bone.name for bone in bones) == sorted(synthetic.NAMES)
    parents = [bones[name].parent.name if bones[name].parent else None for name in synthetic.NAMES]
    assert parents == [synthetic.NAMES[p] if p >= 0 else None for p in synthetic.PARENTS]
    heads = np.array([bones[name].head_local for name in synthetic.NAMES])
    np.testing.assert_allclose(heads, points_to_blender(synthetic.joints()), atol=1e-6)


def test_a_bone_ends_at_its_child(armature):
    bones = armature.data.bones
    for bone, child in (
        ("left_hip", "left_knee"),
        ("pelvis", "spine1"),
        ("spine3", "neck"),
        ("right_elbow", "right_wrist"),
    ):
        assert (bones[bone].tail_local - bones[child].head_local).length < 1e-6


def test_left_and_right_bones_mirror(armature):
    for name in (n for n in synthetic.NAMES if n.startswith("left_")):
        left, right = armature.data.bones[name], armature.data.bones[name.replace("left_", "right_")]
        mirrored = np.array(right.matrix_local.to_3x3()) * np.array([-1, 1, 1])[:, None]
        assert abs(np.linalg.det(mirrored) + 1) < 1e-5
        np.testing.assert_allclose(mirrored[:, 1:], np.array(left.matrix_local.to_3x3())[:, 1:], atol=1e-5)


def test_joints_that_coincide_still_give_24_bones(empty_scene):
    made = build_armature("Human", np.zeros((24, 3)))
    assert len(made.data.bones) == 24


def test_building_keeps_the_active_object_and_leaves_the_armature_unlinked(empty_scene):
    other = bpy.data.objects.new("other", None)
    empty_scene.scene.collection.objects.link(other)
    empty_scene.view_layer.objects.active = other
    made = build_armature("Human", points_to_blender(synthetic.joints()))
    assert empty_scene.view_layer.objects.active == other
    assert made.name not in empty_scene.scene.collection.objects


@pytest.mark.parametrize("seed", range(2))
def test_bone_matrices_are_smpls_skinning_transforms(armature, seed):
    rng = np.random.default_rng(seed)
    rotations, translation = synthetic.random_rotations(rng, 24), rng.normal(0, 1, 3)
    pose_from_joint_rotations(armature, rotations, translation)
    np.testing.assert_allclose(
        joint_matrices(armature)[:, :3, 3], smpl_matrices(rotations, translation)[:, :3, 3], atol=TOLERANCE_M
    )
    np.testing.assert_allclose(joint_matrices(armature), smpl_matrices(rotations, translation), atol=1e-5)


@pytest.mark.any_blender
def test_posing_an_armature_without_smpl_bones_names_the_missing_one(empty_scene):
    other = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    with refused(ValueError, "Rig", "pelvis"):
        pose_from_joint_rotations(other, np.tile(np.eye(3), (24, 1, 1)))


def test_keyframes_meet_every_pose_and_the_frames_between_are_rotations(armature):
    rng = np.random.default_rng(5)
    rotations = synthetic.random_rotations(rng, 4 * 24).reshape(4, 24, 3, 3)
    translations = rng.normal(0, 1, (4, 3))
    frames = np.array([1, 3, 4, 10])
    action = keyframe_poses(armature, frames, rotations, translations)
    assert len(action.layers[0].strips[0].channelbag(action.slots[0]).fcurves) == 24 * 4 + 3
    for frame, rotation, translation in zip(frames, rotations, translations, strict=True):
        bpy.context.scene.frame_set(int(frame))
        np.testing.assert_allclose(joint_matrices(armature), smpl_matrices(rotation, translation), atol=1e-5)
    bpy.context.scene.frame_set(7)
    between = joint_matrices(armature)[:, :3, :3]
    np.testing.assert_allclose(between @ np.swapaxes(between, 1, 2), np.tile(np.eye(3), (24, 1, 1)), atol=1e-5)


@pytest.mark.any_blender
@pytest.mark.parametrize("frames", [[1, 1], [2, 1], [1, 2, 3]])
def test_frames_that_do_not_increase_or_do_not_match_are_rejected(armature, frames):
    with refused(ValueError, "frame"):
        keyframe_poses(armature, np.array(frames), np.tile(np.eye(3), (2, 24, 1, 1)), np.zeros((2, 3)))
    assert len(bpy.data.actions) == 0


@pytest.mark.any_blender
def test_quaternions_of_half_turns_do_not_divide_by_zero():
    half_turns = np.array([np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1]), np.eye(3)])
    np.testing.assert_allclose(np.abs(matrix_to_quaternion(half_turns)), np.eye(4)[[1, 2, 3, 0]], atol=1e-15)


@pytest.mark.any_blender
def test_continuous_quaternions_never_flip_and_stay_the_same_rotations():
    angle = np.linspace(0, 12, 200)
    q = matrix_to_quaternion(synthetic.axis_angle(np.stack([angle, 0 * angle, 0 * angle], -1)))
    smooth = continuous_quaternions(q)
    assert np.abs(np.diff(smooth, axis=0)).max() < 0.05 < np.abs(np.diff(q, axis=0)).max()
    np.testing.assert_allclose(np.abs((q * smooth).sum(-1)), 1, atol=1e-12)


def test_the_proxy_follows_linear_blend_skinning_and_is_hidden(armature):
    human = synthetic.arrays(24)
    body = build_body_mesh(
        "body",
        armature,
        points_to_blender(human["vertices"]),
        human["faces"],
        human["uv_corner"],
        human["skin_weights"],
    )
    bpy.context.scene.collection.objects.link(body)
    assert body.hide_render
    assert body.hide_viewport
    body.hide_viewport = False
    rng = np.random.default_rng(2)
    rotations, translation = synthetic.axis_angle(rng.normal(0, 0.6, (24, 3))), rng.normal(0, 1, 3)
    pose_from_joint_rotations(armature, rotations, translation)
    armature.location, armature.rotation_euler = (1, 2, 3), (0.1, 0.2, 0.3)
    evaluated = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
    seen = np.array([evaluated.matrix_world @ vertex.co for vertex in evaluated.data.vertices])
    matrix = np.array(armature.matrix_world)
    expected = blended_vertices(human, rotations, translation) @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(seen, expected, atol=TOLERANCE_M)
    uv = np.array([loop.uv for loop in body.data.uv_layers[0].data]).reshape(-1, 3, 2)
    np.testing.assert_allclose(uv, human["uv_corner"], atol=1e-6)
