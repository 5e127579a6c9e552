"""IK handles: the pose stays when they are added and baked, feet stay on the floor, and other readers of bones."""

import bpy
import numpy as np
import pytest
import synthetic
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS
from human_files import copy_of
from mathutils import Matrix, Vector
from oracle import Z_UP
from support.errors import refused

from blender_primdiffusion.motion.poses import current_pose
from blender_primdiffusion.scene.actions import action_curves
from blender_primdiffusion.scene.armature import (
    CONTROLS,
    LIMBS,
    build_armature,
    keyframe_poses,
    move_rest_joints,
    pose_from_joint_rotations,
)
from blender_primdiffusion.scene.convention import points_to_blender
from blender_primdiffusion.scene.handles import add_handles, bake_handles, has_handles
from blender_primdiffusion.scene.place import posed_extent
from blender_primdiffusion.ui.motion_panel import built_in_motion
from scripts.bake_poses.poses import LIBRARY

MM = 1e-3
HALF_A_DEGREE = np.radians(0.5)
FEET = ("left_ankle", "right_ankle", "left_foot", "right_foot")


@pytest.fixture(params=["average", pytest.param("synthetic", marks=pytest.mark.any_blender)])
def joints(request) -> np.ndarray:
    return REST_JOINTS if request.param == "average" else synthetic.joints()


@pytest.fixture
def armature(empty_scene, joints):
    made = build_armature("Human", points_to_blender(joints))
    empty_scene.scene.collection.objects.link(made)
    return made


def posed(armature) -> dict[str, np.ndarray]:
    """Matrices of SMPL's bones in the armature's space."""
    bpy.context.view_layer.update()
    bones = armature.evaluated_get(bpy.context.evaluated_depsgraph_get()).pose.bones
    return {name: np.array(bones[name].matrix, np.float64) for name in synthetic.NAMES}


def by_definition(armature, joints, rotations, translation) -> dict[str, np.ndarray]:
    """The same, as SMPL defines the skinning transforms."""
    skinned = Z_UP @ synthetic.skinning(joints, rotations, translation) @ Z_UP.T
    rest = [np.array(armature.data.bones[name].matrix_local) for name in synthetic.NAMES]
    return dict(zip(synthetic.NAMES, skinned @ np.array(rest), strict=True))


def distances(before, after, names=synthetic.NAMES) -> tuple[float, float]:
    """The largest distance, metres, and turn, radians, between bones."""
    apart = [np.linalg.norm(before[name][:3, 3] - after[name][:3, 3]) for name in names]
    chords = [np.linalg.norm(before[name][:3, :3] - after[name][:3, :3]) / np.sqrt(8) for name in names]
    return max(apart), 2 * float(np.arcsin(np.clip(max(chords), 0, 1)))


def assert_same(before, after, names=synthetic.NAMES, *, place=0.05 * MM, turn=0.02 * HALF_A_DEGREE) -> None:
    apart, turned = distances(before, after, names)
    assert apart < place
    assert turned < turn


def lower(armature, by: float) -> None:
    pelvis = armature.pose.bones["pelvis"]
    pelvis.location += pelvis.bone.matrix_local.to_3x3().inverted() @ Vector((0, 0, -by))


def test_adding_and_baking_handles_keep_every_pose(armature, joints):
    poses = [pose.rotations() for pose in LIBRARY.values()]
    poses += [synthetic.axis_angle(np.random.default_rng(seed).normal(0, 0.6, (24, 3))) for seed in range(4)]
    translation = np.array([0.3, -0.1, 0.2])
    for rotations in poses:
        pose_from_joint_rotations(armature, rotations, translation)
        expected = by_definition(armature, joints, rotations, translation)
        add_handles(bpy.context, armature)
        assert_same(expected, posed(armature))
        bake_handles(bpy.context, armature)
        assert_same(expected, posed(armature))
        assert sorted(bone.name for bone in armature.data.bones) == sorted(synthetic.NAMES)


@pytest.mark.parametrize("name", ["T", "Relaxed", "Walking", "Contrapposto"])
def test_feet_stay_on_the_floor_and_knees_bend_forward_when_the_pelvis_goes_down(armature, joints, name):
    rotations = np.tile(np.eye(3), (24, 1, 1)) if name == "T" else LIBRARY[name].rotations()
    pose_from_joint_rotations(armature, rotations)
    before = posed(armature)
    add_handles(bpy.context, armature)
    lower(armature, 0.1)
    after = posed(armature)
    assert_same(before, after, FEET, place=MM, turn=HALF_A_DEGREE)
    assert before["pelvis"][2, 3] - after["pelvis"][2, 3] == pytest.approx(0.1, abs=1e-5)
    for side in ("left", "right"):
        hip, knee, ankle = (after[f"{side}_{part}"][:3, 3] for part in ("hip", "knee", "ankle"))
        assert knee[1] < (hip[1] + ankle[1]) / 2 - 0.05
    bake_handles(bpy.context, armature)
    assert_same(after, posed(armature))
    assert_same(after, by_definition(armature, joints, *current_pose(armature)))


def test_hands_and_feet_go_and_turn_where_their_handles_do(armature):
    add_handles(bpy.context, armature)
    for side, sign in (("left", 1), ("right", -1)):
        hand, foot = (armature.pose.bones[f"{side}_{part}_ik"] for part in ("hand", "foot"))
        for bone, way in ((hand, (-0.25 * sign, -0.2, 0.1)), (foot, (0, -0.2, 0.25))):
            bone.matrix = Matrix.Translation(way) @ bone.bone.matrix_local
            bone.rotation_quaternion = (0.9, 0.3, 0.1, -0.2)
    after = posed(armature)
    for limb in LIMBS:
        wanted = np.array(armature.pose.bones[limb.handle].matrix)
        assert_same({limb.end: wanted}, after, [limb.end], place=MM, turn=HALF_A_DEGREE)
    for side in ("left", "right"):
        shoulder, elbow, wrist = (after[f"{side}_{part}"][:3, 3] for part in ("shoulder", "elbow", "wrist"))
        assert elbow[1] > (shoulder[1] + wrist[1]) / 2 + 0.05, "elbows bend backwards"
    bake_handles(bpy.context, armature)
    assert_same(after, posed(armature))


def test_a_knee_follows_its_pole(armature):
    add_handles(bpy.context, armature)
    lower(armature, 0.15)
    before = posed(armature)
    armature.pose.bones["left_knee_pole"].location.x += 0.4
    after = posed(armature)
    assert after["left_knee"][0, 3] > before["left_knee"][0, 3] + 0.03
    assert_same(before, after, [name for name in synthetic.NAMES if name not in ("left_hip", "left_knee")])


def walking(armature):
    motion = built_in_motion("WALK")
    motion = motion.frames(np.arange(0, len(motion), 2))
    frames = np.arange(5, 5 + len(motion))
    keyframe_poses(armature, frames, motion.rotations, motion.translations)
    return frames


def each(armature, frames) -> list[dict[str, np.ndarray]]:
    found = []
    for frame in frames:
        bpy.context.scene.frame_set(int(frame))
        found.append(posed(armature))
    return found


def assert_each(before, armature, frames) -> None:
    for expected, seen in zip(before, each(armature, frames), strict=True):
        assert_same(expected, seen)


@pytest.mark.parametrize(("strips", "curves"), [(False, 25), (True, 12)], ids=["action", "strips"])
def test_a_walk_stays_the_same_with_handles_and_after_baking_into_an_action_above_any_strips(armature, strips, curves):
    frames = walking(armature)
    if strips:
        animation = armature.animation_data
        strip = animation.nla_tracks.new().strips.new("walk", int(frames[0]), animation.action)
        strip.action_slot, animation.action = animation.action_slot, None
    before = each(armature, frames)
    add_handles(bpy.context, armature)
    assert_each(before, armature, frames)
    bake_handles(bpy.context, armature)
    assert_each(before, armature, frames)
    paths = {curve.data_path for curve in action_curves(armature)}
    assert len(paths) == curves, "24 rotations and the pelvis' location; above strips the rotations of the limbs"


def test_handles_of_scaled_bones_turn_as_the_bones_do(armature):
    frames = walking(armature)
    armature.pose.bones["left_wrist"].scale = (2, 2, 2)
    before = [{name: unscaled(matrix) for name, matrix in shown.items()} for shown in each(armature, frames)]
    add_handles(bpy.context, armature)
    after = [{name: unscaled(matrix) for name, matrix in shown.items()} for shown in each(armature, frames)]
    for expected, seen in zip(before, after, strict=True):
        assert distances(expected, seen, ["left_wrist"])[1] < HALF_A_DEGREE


def unscaled(matrix: np.ndarray) -> np.ndarray:
    matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)
    return matrix


def test_a_walk_with_the_pelvis_lowered_and_a_handle_keyed_is_baked_on_every_frame(armature):
    frames = walking(armature)
    before = each(armature, frames)
    add_handles(bpy.context, armature)
    up = armature.data.bones["pelvis"].matrix_local.to_3x3().inverted() @ Vector((0, 0, 1))
    for axis in range(3):
        curve = action_curves(armature).find('pose.bones["pelvis"].location', index=axis)
        for point in curve.keyframe_points:
            point.co[1] -= 0.08 * up[axis]
    lowered = each(armature, frames)
    for old, new in zip(before, lowered, strict=True):
        assert_same(old, new, FEET, place=MM, turn=HALF_A_DEGREE)
    bake_handles(bpy.context, armature)
    assert_each(lowered, armature, frames)


def test_handles_keyed_by_hand_are_baked_between_their_keys(armature):
    add_handles(bpy.context, armature)
    foot = armature.pose.bones["left_foot_ik"]
    foot.keyframe_insert("location", frame=3)
    foot.location += foot.bone.matrix_local.to_3x3().inverted() @ Vector((0, -0.3, 0.2))
    foot.keyframe_insert("location", frame=9)
    shown = each(armature, range(1, 12))
    bake_handles(bpy.context, armature)
    assert_each(shown, armature, range(1, 12))
    assert not [curve for curve in action_curves(armature) if "_ik" in curve.data_path]


def test_an_action_that_another_human_uses_is_left_alone(armature, joints):
    frames = walking(armature)
    other = build_armature("Other", points_to_blender(joints))
    bpy.context.scene.collection.objects.link(other)
    animation = other.animation_data_create()
    animation.action = armature.animation_data.action
    animation.action_slot = armature.animation_data.action_slot
    before = each(other, frames[::5])
    add_handles(bpy.context, armature)
    lower(armature, 0.1)
    bake_handles(bpy.context, armature)
    assert animation.action != armature.animation_data.action
    assert_each(before, other, frames[::5])


@pytest.mark.any_blender
def test_bones_that_another_object_uses_are_left_alone(armature):
    other = bpy.data.objects.new("Other", armature.data)
    bpy.context.scene.collection.objects.link(other)
    add_handles(bpy.context, armature)
    assert len(other.data.bones) == 24
    assert len(armature.data.bones) == 24 + len(CONTROLS)


@pytest.mark.any_blender
def test_a_hidden_armature_at_rest_gets_its_handles_too(armature):
    pose_from_joint_rotations(armature, LIBRARY["Squatting"].rotations())
    before = posed(armature)
    armature.hide_viewport, armature.data.pose_position = True, "REST"
    add_handles(bpy.context, armature)
    armature.hide_viewport, armature.data.pose_position = False, "POSE"
    assert_same(before, posed(armature))


def test_handles_follow_another_shape_and_feet_stay_at_them(armature, joints):
    pose_from_joint_rotations(armature, LIBRARY["Relaxed"].rotations())
    add_handles(bpy.context, armature)
    taller = joints * [1.1, 1.15, 0.9] + np.array([0.0, 0.05, 0.01])
    at_rest = {limb.handle: points_to_blender(taller)[synthetic.NAMES.index(limb.end)] for limb in LIMBS}
    move_rest_joints(armature.data, points_to_blender(taller))
    for handle, place in at_rest.items():
        np.testing.assert_allclose(armature.data.bones[handle].head_local, place, atol=1e-5)
    lower(armature, 0.1)
    after = posed(armature)
    for side in ("left", "right"):
        foot = np.array(armature.pose.bones[f"{side}_foot_ik"].matrix)
        assert_same({f"{side}_ankle": foot}, after, [f"{side}_ankle"], place=MM, turn=HALF_A_DEGREE)
    bake_handles(bpy.context, armature)
    assert_same(after, posed(armature))
    assert_same(after, by_definition(armature, taller, *current_pose(armature)))


def test_handles_are_added_in_pose_mode_and_the_mode_stays(armature):
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="POSE")
    before = posed(armature)
    add_handles(bpy.context, armature)
    assert armature.mode == "POSE"
    assert_same(before, posed(armature))
    bake_handles(bpy.context, armature)
    assert armature.mode == "POSE"
    assert_same(before, posed(armature))


@pytest.mark.any_blender
def test_what_cannot_be_done_is_rejected_and_changes_nothing(armature):
    with refused(ValueError, "no IK handles"):
        bake_handles(bpy.context, armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    with refused(ValueError, "Edit Mode"):
        add_handles(bpy.context, armature)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert len(armature.data.bones) == 24
    add_handles(bpy.context, armature)
    with refused(ValueError, "has IK handles"):
        add_handles(bpy.context, armature)
    assert len(armature.data.bones) == 24 + len(CONTROLS)


@pytest.mark.any_blender
def test_a_human_with_handles_is_as_large_as_without(person):
    before = posed_extent(person)
    add_handles(bpy.context, person)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(posed_extent(person), before, atol=1e-5)


def test_a_copy_has_handles_of_its_own(person):
    armature = person
    add_handles(bpy.context, armature)
    twin = copy_of(person)
    before, twins = posed(armature), posed(twin)
    twin.pose.bones["left_foot_ik"].location.y += 0.2
    assert_same(before, posed(armature))
    assert distances(twins, posed(twin))[0] > 0.05
    twin_shown = posed(twin)
    bake_handles(bpy.context, twin)
    assert has_handles(armature)
    assert_same(before, posed(armature))
    assert_same(twin_shown, posed(twin))
