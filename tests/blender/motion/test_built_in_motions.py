"""Motions of our own: feet that stay where they are put down, ends that meet beginnings."""

from __future__ import annotations

import numpy as np
import pytest
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rotation import to_axis_angle
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS, chain, joint_positions

from blender_primdiffusion.motion.built_in_motions import MOTIONS, built_in_motion
from blender_primdiffusion.motion.legs import FLOOR, FootTrack, joint, reach

pytestmark = pytest.mark.any_blender

ANKLES = [JOINT_NAMES.index("left_ankle"), JOINT_NAMES.index("right_ankle")]
KNEES = [JOINT_NAMES.index("left_knee"), JOINT_NAMES.index("right_knee")]
FEET = [JOINT_NAMES.index("left_foot"), JOINT_NAMES.index("right_foot")]


@pytest.mark.parametrize("name", [name for name, motion in MOTIONS.items() if motion.loops])
def test_a_loops_end_is_its_beginning(name):
    motion = built_in_motion(name, 1, 30.0)
    np.testing.assert_allclose(motion.rotations[-1], motion.rotations[0], atol=1e-9)
    moved = motion.translations[-1] - motion.translations[0]
    np.testing.assert_allclose(moved[:2], 0, atol=1e-9)


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("fps", [24.0, 60.0, 24000 / 1001])
def test_rounds_take_the_seconds_they_say(name, fps):
    motion = built_in_motion(name, 3, fps)
    assert (len(motion) - 1) / motion.fps == pytest.approx(3 * MOTIONS[name].seconds, abs=1 / fps)


@pytest.mark.parametrize("name", MOTIONS)
def test_no_joint_jumps(name):
    motion = built_in_motion(name, 2, 60.0)
    turned = np.linalg.norm(to_axis_angle(np.swapaxes(motion.rotations[:-1], -1, -2) @ motion.rotations[1:]), axis=-1)
    assert np.degrees(turned).max() < 14
    assert np.linalg.norm(np.diff(motion.translations, axis=0), axis=-1).max() < 0.03


@pytest.mark.parametrize("name", MOTIONS)
def test_feet_neither_sink_into_the_floor_nor_float(name):
    joints = built_in_motion(name, 1, 30.0).joints()
    ball = joints[:, FEET, 1] - (REST_JOINTS[FEET[0], 1] - FLOOR)
    assert (ball.min(1) > FLOOR - 0.025).all()
    heel = joints[:, ANKLES, 1] - (REST_JOINTS[ANKLES[0], 1] - FLOOR)
    assert (np.minimum(ball, heel).min(1) < FLOOR + 0.03).all()


def test_walking_feet_do_not_slide():
    motion = built_in_motion("WALK", 2, 60.0)
    joints = motion.joints()
    for foot, ankle in zip(FEET, ANKLES, strict=True):
        flat = np.abs(joints[:, foot, 1] - REST_JOINTS[foot, 1]) < 0.002
        flat &= np.abs(joints[:, ankle, 1] - REST_JOINTS[ankle, 1]) < 0.002
        both = flat[1:] & flat[:-1]
        assert both.mean() > 0.2
        assert np.linalg.norm(np.diff(joints[:, [foot, ankle]][..., [0, 2]], axis=0)[both], axis=-1).max() < 1e-3
        swings = np.diff(joints[:, foot, 2]) * motion.fps > 0.6
        assert swings.mean() < 0.45
        assert joints[1:][swings][:, foot, 1].min() > REST_JOINTS[foot, 1] - 0.012  # the toes' joint, heel high


def test_walking_goes_forward_and_knees_bend_forward():
    motion = built_in_motion("WALK", 2, 30.0)
    assert motion.translations[-1, 2] - motion.translations[0, 2] == pytest.approx(2.56)
    world = chain(motion.rotations)
    for knee in KNEES:
        turn = to_axis_angle(motion.rotations[:, knee])
        assert (turn[:, 0] > -1e-3).all()
        assert np.degrees(turn[:, 0]).max() > 45
    assert (world[:, 0, 2, 2] > 0.98).all()


def test_turning_is_a_quarter_to_the_left_each_round():
    motion = built_in_motion("TURN", 2, 30.0)
    facing = chain(motion.rotations)[[0, -1], 0, :, 2]
    np.testing.assert_allclose(facing, [[0, 0, 1], [0, 0, -1]], atol=0.06)
    half = chain(built_in_motion("TURN", 1, 30.0).rotations)[-1, 0, :, 2]
    np.testing.assert_allclose(half, [1, 0, 0], atol=0.06)


def test_legs_reach_the_target_feet_and_stretch_towards_those_too_far():
    rest = np.tile(np.eye(3), (2, 24, 1, 1))
    still = np.zeros(2)
    near = joint("left_ankle") + np.array([0.05, 0.2, 0.1])
    far = joint("left_ankle") + np.array([0.0, -1.0, 0.0])
    foot = FootTrack(np.array([near, far]), np.array([0.3, 0.0]), still, still)
    posed = reach(rest, np.zeros((2, 3)), {"left": foot})
    joints = joint_positions(posed)
    np.testing.assert_allclose(joints[0, ANKLES[0]], near, atol=1e-9)
    straight = joints[1, ANKLES[0]] - joints[1, JOINT_NAMES.index("left_hip")]
    np.testing.assert_allclose(np.cross(straight, far - joint("left_hip")), 0, atol=1e-9)
    np.testing.assert_allclose(chain(posed)[0, ANKLES[0]] @ [0, 0, 1], [0, np.sin(0.3), np.cos(0.3)], atol=1e-9)
    np.testing.assert_array_equal(posed[:, JOINT_NAMES.index("right_hip")], rest[:, 0])
