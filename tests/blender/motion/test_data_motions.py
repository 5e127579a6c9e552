"""Motions of our own: feet that stay where they are put down, ends that meet beginnings."""

from __future__ import annotations

import numpy as np
import pytest
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rotation import to_axis_angle
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS, chain

from blender_primdiffusion.motion.placing import rounds_of
from blender_primdiffusion.motion.poses import FLOOR
from blender_primdiffusion.ui.motion_panel import built_in_motion
from scripts.bake_poses import motions

pytestmark = pytest.mark.any_blender

SECONDS = {"WALK": 1.1, "IDLE": 6.0, "WAVE": 3.0, "TURN": 2.4}
ANKLES = [JOINT_NAMES.index("left_ankle"), JOINT_NAMES.index("right_ankle")]
KNEES = [JOINT_NAMES.index("left_knee"), JOINT_NAMES.index("right_knee")]
FEET = [JOINT_NAMES.index("left_foot"), JOINT_NAMES.index("right_foot")]


def turns(motion) -> np.ndarray:
    """Degrees of each joint from frame to frame."""
    between = np.swapaxes(motion.rotations[:-1], -1, -2) @ motion.rotations[1:]
    return np.degrees(np.linalg.norm(to_axis_angle(between), axis=-1))


@pytest.mark.parametrize("name", SECONDS)
def test_the_file_is_what_the_script_makes(name):
    motion, made = built_in_motion(name), getattr(motions, name.lower())()
    np.testing.assert_allclose(motion.rotations, made.rotations, atol=1e-6)
    np.testing.assert_allclose(motion.translations, made.translations, atol=1e-6)
    assert motion.fps == made.fps


@pytest.mark.parametrize("name", ["WALK", "IDLE", "WAVE"])
def test_a_loops_end_is_its_beginning(name):
    motion = built_in_motion(name)
    np.testing.assert_allclose(motion.rotations[-1], motion.rotations[0], atol=1e-6)
    moved = motion.translations[-1] - motion.translations[0]
    np.testing.assert_allclose(moved[:2], 0, atol=1e-6)


@pytest.mark.parametrize("name", SECONDS)
def test_rounds_take_the_seconds_they_say_and_no_joint_jumps(name):
    motion = rounds_of(built_in_motion(name), 3)
    assert (len(motion) - 1) / motion.fps == pytest.approx(3 * SECONDS[name])
    assert turns(motion).max() * motion.fps < 60 * 14
    assert np.linalg.norm(np.diff(motion.translations, axis=0), axis=-1).max() * motion.fps < 60 * 0.03


@pytest.mark.parametrize("name", SECONDS)
def test_feet_neither_sink_into_the_floor_nor_float(name):
    joints = rounds_of(built_in_motion(name), 2).joints()
    ball = joints[:, FEET, 1] - (REST_JOINTS[FEET[0], 1] - FLOOR)
    assert (ball.min(1) > FLOOR - 0.025).all()
    heel = joints[:, ANKLES, 1] - (REST_JOINTS[ANKLES[0], 1] - FLOOR)
    assert (np.minimum(ball, heel).min(1) < FLOOR + 0.03).all()


def test_walking_feet_do_not_slide():
    motion = rounds_of(built_in_motion("WALK"), 2)
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
    motion = rounds_of(built_in_motion("WALK"), 2)
    assert motion.translations[-1, 2] - motion.translations[0, 2] == pytest.approx(2.56)
    world = chain(motion.rotations)
    for knee in KNEES:
        turn = to_axis_angle(motion.rotations[:, knee])
        assert (turn[:, 0] > -1e-3).all()
        assert np.degrees(turn[:, 0]).max() > 45
    assert (world[:, 0, 2, 2] > 0.98).all()


def test_turning_is_a_quarter_to_the_left_each_round():
    motion = rounds_of(built_in_motion("TURN"), 2)
    facing = motion.rotations[[0, len(motion) // 2, -1], 0, :, 2]
    np.testing.assert_allclose(facing, [[0, 0, 1], [1, 0, 0], [0, 0, -1]], atol=0.06)
    standing = motion.joints()[[0, -1]][:, ANKLES]
    np.testing.assert_allclose(standing.mean(1)[0], standing.mean(1)[1], atol=0.06)
