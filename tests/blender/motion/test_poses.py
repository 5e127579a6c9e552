"""Rotations, skeletons, our own poses, and picking poses out of motion."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.motion import Motion, built_in_vectors
from blender_primdiffusion.formats.poses.rotation import (
    about_axis,
    between,
    from_axis_angle,
    from_quaternion,
    nearest,
    to_axis_angle,
)
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS, chain, unchain
from support.errors import refused

from blender_primdiffusion.capture.body import read_body
from blender_primdiffusion.motion.poses import FLOOR, built_in_poses, pick_poses
from scripts.bake_poses.poses import BUILT_IN

pytestmark = pytest.mark.any_blender

RNG = np.random.default_rng(7)


def random_motion(frames: int, seed: int, spread: float = 0.4) -> Motion:
    rng = np.random.default_rng(seed)
    rotations = from_axis_angle(rng.normal(0, spread, (frames, 24, 3)))
    return Motion(rotations, rng.normal(0, 1, (frames, 3)), 30.0, f"random {seed}")


def test_rotations_are_scipys():
    scipy = pytest.importorskip("scipy.spatial.transform")
    vectors = RNG.normal(0, 1.2, (200, 3))
    twin = scipy.Rotation.from_rotvec(vectors)
    np.testing.assert_allclose(from_axis_angle(vectors), twin.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(to_axis_angle(twin.as_matrix()), twin.as_rotvec(), atol=1e-9)
    np.testing.assert_allclose(from_quaternion(twin.as_quat()[:, [3, 0, 1, 2]] * 3), twin.as_matrix(), atol=1e-12)


def test_a_rotation_about_an_axis_is_that_of_the_axis_angle_also_of_many():
    angles = np.linspace(-7, 7, 150_001)
    for axis in range(3):
        vectors = np.zeros((len(angles), 3))
        vectors[:, axis] = angles
        np.testing.assert_allclose(about_axis(axis, angles), from_axis_angle(vectors), atol=1e-14)
        np.testing.assert_array_equal(from_axis_angle(vectors)[-9:], from_axis_angle(vectors[-9:]))


def test_axis_angles_come_back_at_no_turn_and_at_half_a_turn():
    vectors = np.array([[0, 0, 0], [1e-9, 0, 0], [0, 1e-5, 0], [np.pi - 1e-7, 0, 0]])
    np.testing.assert_allclose(to_axis_angle(from_axis_angle(vectors)), vectors, atol=1e-8)
    half = to_axis_angle(np.diag([-1.0, 1, -1]))
    np.testing.assert_allclose(np.abs(half), [0, np.pi, 0], atol=1e-12)


def test_turning_one_direction_to_another_is_the_shortest_way():
    for _ in range(20):
        a, b = RNG.normal(size=(2, 3))
        turn = between(a, b)
        np.testing.assert_allclose(turn @ a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-12)
        axis = to_axis_angle(turn)
        assert abs(axis @ a) < 1e-9
    np.testing.assert_allclose(between([0, 0, 2], [0, 0, -1]) @ [0, 0, 1], [0, 0, -1], atol=1e-12)


def test_the_nearest_rotation_of_a_bent_matrix_is_a_rotation():
    bent = from_axis_angle(RNG.normal(size=(5, 3))) + RNG.normal(0, 1e-3, (5, 3, 3))
    straight = nearest(bent)
    np.testing.assert_allclose(straight @ np.swapaxes(straight, 1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-12)
    assert (np.linalg.det(straight) > 0).all()
    np.testing.assert_allclose(straight, bent, atol=5e-3)


def test_the_average_skeleton_is_the_default_bodys():
    np.testing.assert_allclose(REST_JOINTS, read_body().rest(np.zeros(10))[1], atol=6e-4)
    np.testing.assert_allclose(FLOOR, read_body().template[:, 1].min(), atol=6e-4)


def test_unchaining_undoes_chaining():
    rotations = random_motion(3, 0).rotations
    np.testing.assert_allclose(unchain(chain(rotations)), rotations, atol=1e-12)


def test_joints_of_a_motion_are_the_backends_bodys():
    torch, model = pytest.importorskip("torch"), pytest.importorskip("primdiffusion.body.model")
    motion, body = random_motion(4, 1), read_body()
    betas = RNG.normal(size=10)
    pose = model.BodyPose.from_axis_angle(
        torch.from_numpy(motion.axis_angle().reshape(4, 72)), torch.from_numpy(motion.translations)
    )
    twin = model.default_body().to(dtype=torch.float64, device="cpu").shape(torch.from_numpy(betas)).pose(pose)
    ours = [body.pose(betas, *both)[1] for both in zip(motion.rotations, motion.translations, strict=True)]
    np.testing.assert_allclose(ours, twin.joints[..., :3, 3].numpy(), atol=1e-5)


def test_joints_of_a_skeleton_are_those_of_skinning():
    motion = random_motion(1, 2)
    transforms = synthetic.skinning(REST_JOINTS, motion.rotations[0], motion.translations[0])
    expected = np.einsum("jrc,jc->jr", transforms[:, :3, :3], REST_JOINTS) + transforms[:, :3, 3]
    np.testing.assert_allclose(motion.joints()[0], expected, atol=1e-12)


def test_a_motion_of_unlike_lengths_is_rejected():
    with refused(ValueError, "2 frames"):
        Motion(np.tile(np.eye(3), (2, 24, 1, 1)), np.zeros((3, 3)), 30.0, "x")


def test_there_are_twenty_built_in_poses_and_the_first_is_nearly_a_t():
    motion = built_in_poses(20)
    assert len(motion) == 20 == len(built_in_vectors())
    arms = motion.joints()[0][[JOINT_NAMES.index("left_wrist"), JOINT_NAMES.index("right_wrist")]]
    rest = REST_JOINTS[[JOINT_NAMES.index("left_wrist"), JOINT_NAMES.index("right_wrist")]]
    assert (np.abs(arms - rest)[:, 0] < 0.03).all()
    assert (arms[:, 1] < rest[:, 1] - 0.03).all()  # a little below the horizontal
    turned = np.linalg.norm(motion.axis_angle()[0], axis=-1)
    assert np.degrees(turned).max() < 12


def test_the_file_of_poses_is_what_the_script_makes():
    assert list(built_in_vectors()) == list(BUILT_IN)
    for name, vectors in built_in_vectors().items():
        np.testing.assert_allclose(from_axis_angle(vectors), BUILT_IN[name].rotations(), atol=1e-5)


def test_built_in_poses_stand_on_the_floor():
    body, motion = read_body(), built_in_poses(20)
    lowest = [
        body.pose(np.zeros(10), *pose)[0][:, 1].min()
        for pose in zip(motion.rotations, motion.translations, strict=True)
    ]
    np.testing.assert_allclose(lowest, FLOOR, atol=0.06)


def test_left_is_left():
    named = dict(zip(built_in_vectors(), built_in_poses(20).joints(), strict=True))
    waving, walking = named["waving"], named["walking"]
    assert waving[JOINT_NAMES.index("right_wrist")][1] > waving[JOINT_NAMES.index("head")][1]
    assert waving[JOINT_NAMES.index("left_wrist")][1] < waving[JOINT_NAMES.index("pelvis")][1] + 0.1
    assert walking[JOINT_NAMES.index("left_ankle")][2] > walking[JOINT_NAMES.index("right_ankle")][2] + 0.3
    assert walking[JOINT_NAMES.index("left_wrist")][2] < walking[JOINT_NAMES.index("right_wrist")][2]


def test_no_built_in_pose_puts_a_hand_or_a_forearm_into_the_trunk():
    body, motion = read_body(), built_in_poses(20)
    joint = body.skin_weights.argmax(1)
    hands = np.isin(joint, [JOINT_NAMES.index(f"{s}_{p}") for s in ("left", "right") for p in ("wrist", "hand")])
    trunk = np.isin(joint, [JOINT_NAMES.index(p) for p in ("pelvis", "spine1", "spine2", "spine3")])
    inner = trunk[body.faces].all(1)
    from mathutils.bvhtree import BVHTree

    for name, *pose in zip(built_in_vectors(), motion.rotations, motion.translations, strict=True):
        vertices = body.pose(np.zeros(10), *pose)[0]
        tree = BVHTree.FromPolygons(vertices.tolist(), body.faces[inner].tolist())
        deep = []
        for point in vertices[hands][::9]:
            place, normal, _, distance = tree.find_nearest(point.tolist())
            if (point - np.array(place)) @ np.array(normal) < 0 and distance < 0.1:
                deep.append(distance)
        assert max(deep, default=0) < 0.02, name


def test_picked_poses_begin_near_t_and_are_spread_better_than_chance():
    clumsy = Motion(
        np.concatenate([np.tile(random_motion(1, 3).rotations, (80, 1, 1, 1)), built_in_poses(20).rotations]),
        np.zeros((100, 3)), 30.0, "clip",
    )  # fmt: skip
    picked = pick_poses([clumsy], 12, seed=1)
    assert len(picked) == 12
    np.testing.assert_array_equal(picked.rotations[0], built_in_poses(1).rotations[0])
    apart = np.linalg.norm(picked.joints()[:, None] - picked.joints()[None], axis=-1).mean(-1)
    assert apart[~np.eye(12, dtype=bool)].min() > 0.1


def test_without_a_frame_near_t_the_first_is_built_in():
    bent = about_axis(0, -1.5) @ np.eye(3)
    rotations = random_motion(30, 4).rotations
    rotations[:, JOINT_NAMES.index("left_hip")] = bent
    rotations[:, JOINT_NAMES.index("left_shoulder")] = about_axis(2, -1.4)
    picked = pick_poses([Motion(rotations, np.zeros((30, 3)), 30.0, "clip")], 5)
    np.testing.assert_array_equal(picked.rotations[0], built_in_poses(1).rotations[0])


def test_the_same_seed_picks_the_same_poses_of_a_long_motion():
    long = random_motion(4500, 5)
    first, second, other = (pick_poses([long], 6, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.rotations, second.rotations)
    assert not np.array_equal(first.rotations, other.rotations)


def test_a_pose_does_not_depend_on_which_way_the_person_faces():
    motion = random_motion(40, 6, 0.2)
    turned = np.array(motion.rotations)
    turned[:, 0] = about_axis(1, 2.0) @ turned[:, 0]
    a, b = (pick_poses([Motion(r, motion.translations, 30.0, "m")], 8) for r in (motion.rotations, turned))
    np.testing.assert_allclose(a.rotations[1:, 1:], b.rotations[1:, 1:])
