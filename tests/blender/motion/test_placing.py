"""Motion cut, resampled, grounded and scaled; the up axis and the bones of a file chosen by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scan_fixtures
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.files import read_motion, write_amass
from blender_primdiffusion.formats.poses.motion import Detected, Motion
from blender_primdiffusion.formats.poses.rotation import about_axis, from_axis_angle, slerp
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS, joint_positions
from bvh_files import motion_of, write_bvh
from support.errors import refused

from blender_primdiffusion.motion.placing import (
    Placement,
    cut,
    from_origin,
    in_place,
    leg_ratio,
    on_floor,
    place_motion,
    resample,
    rounds_of,
    scale_places,
    stride_ratio,
)
from blender_primdiffusion.scene.armature import build_armature
from blender_primdiffusion.scene.convention import points_to_blender
from blender_primdiffusion.ui.motion_panel import built_in_motion

pytestmark = pytest.mark.any_blender

REST = np.tile(np.eye(3), (24, 1, 1))


def spin(frames: int, fps: float, degrees_a_second: float = 400.0) -> Motion:
    """Every joint about its own axis at one speed, the body along +x at one metre a second."""
    axes = np.random.default_rng(0).normal(size=(24, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    time = np.arange(frames) / fps
    turns = from_axis_angle(axes * np.radians(degrees_a_second) * time[:, None, None])
    return Motion(turns, time[:, None] * [1.0, 0.0, 0.0], fps, "spin")


@pytest.mark.parametrize("fps", [24.0, 24000 / 1001, 60.0, 120.0])
def test_an_even_turn_stays_even_at_any_rate(fps):
    made = resample(spin(61, 60.0), fps)
    wanted = spin(len(made), fps)
    assert len(made) == int(np.floor(fps * 1.0 + 1e-6)) + 1
    np.testing.assert_allclose(made.rotations, wanted.rotations, atol=1e-9)
    np.testing.assert_allclose(made.translations, wanted.translations, atol=1e-12)


def test_half_way_between_two_quaternions_is_half_the_turn_the_short_way():
    a, b = np.array([1.0, 0, 0, 0]), -np.array([np.cos(0.5), np.sin(0.5), 0, 0])
    np.testing.assert_allclose(slerp(a, b, 0.5), [np.cos(0.25), np.sin(0.25), 0, 0], atol=1e-12)
    np.testing.assert_allclose(slerp(a, a, 0.3), a, atol=1e-12)


def test_one_pose_has_no_time_to_resample():
    assert len(resample(spin(1, 30.0), 24.0)) == 1


def test_cutting_counts_from_one():
    motion = spin(10, 30.0)
    np.testing.assert_array_equal(cut(motion, 3, 5).translations, motion.translations[2:5])
    for wrong in ((11, 0), (5, 4)):
        with refused(ValueError, "frames"):
            cut(motion, *wrong)


def test_the_floor_is_where_feet_are_most_of_the_time_and_jumps_stay():
    heights = np.full(40, 1.3)
    heights[20:25] = 1.8
    motion = Motion(np.tile(REST, (40, 1, 1, 1)), np.stack([heights * 0, heights, heights * 0], -1), 30.0, "jump")
    grounded = on_floor(motion)
    np.testing.assert_allclose(grounded.translations[:, 1], heights - 1.3, atol=1e-12)


def test_paths_begin_at_the_person_or_go_nowhere():
    motion = Motion(np.tile(REST, (2, 1, 1, 1)), np.array([[3.0, 1, 5], [4, 2, 7]]), 30.0, "m")
    np.testing.assert_array_equal(from_origin(motion).translations, [[0, 1, 0], [1, 2, 2]])
    np.testing.assert_array_equal(in_place(motion).translations, [[0, 1, 0], [0, 2, 0]])


def test_legs_twice_as_long_are_twice_as_long():
    assert leg_ratio(REST_JOINTS * 2) == pytest.approx(2)


@pytest.mark.parametrize("axis", ["x", "-x", "-y", "z", "-z"])
def test_a_given_up_axis_is_turned_up(tmp_path, axis):
    pose = np.zeros((2, 24, 3))
    direction = np.eye(3)["xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
    up = np.array([0.0, 1.0, 0.0])
    turn = np.cross(up, direction) * np.pi / 2 if axis[-1] != "y" else np.array([np.pi, 0, 0])
    pose[:, 0] = turn
    np.savez(tmp_path / "p.npz", pose=pose.reshape(2, 72))
    motion = read_motion(tmp_path / "p.npz", axis)
    np.testing.assert_allclose(motion.rotations[0, 0] @ up, up, atol=1e-9)
    assert motion.detected.up == axis


def test_an_axis_that_is_none_is_rejected(tmp_path):
    np.save(tmp_path / "p.npy", np.zeros(72))
    with refused(ValueError, "w"):
        read_motion(tmp_path / "p.npy", "w")


def test_the_up_axis_of_a_bvh_is_reported_and_taken_in_the_files_own_axes(tmp_path):
    rotations, moves = motion_of(0.2)
    z_up = about_axis(0, np.pi / 2)
    rest = REST_JOINTS @ z_up.T
    turned = z_up @ rotations @ z_up.T
    root = (REST_JOINTS[0] + moves) @ z_up.T
    path = write_bvh(tmp_path / "m.bvh", rest, turned, root, scan_fixtures.MIXAMO)
    found, given = read_motion(path), read_motion(path, "z")
    assert found.detected.up == given.detected.up == "z"
    np.testing.assert_allclose(found.rotations, given.rotations, atol=1e-12)
    np.testing.assert_allclose(found.translations, moves, atol=1e-5)


BALLS = [JOINT_NAMES.index(f"{side}_foot") for side in ("left", "right")]
STEPS = 8


def longer_legs(factor: float) -> np.ndarray:
    """The average skeleton [24, 3] with other legs; feet and hips are its own."""
    rest = np.array(REST_JOINTS)
    for side in ("left", "right"):
        hip, knee, ankle, foot = (JOINT_NAMES.index(f"{side}_{part}") for part in ("hip", "knee", "ankle", "foot"))
        rest[[knee, ankle]] = rest[hip] + factor * (rest[[knee, ankle]] - rest[hip])
        rest[foot] = rest[ankle] + REST_JOINTS[foot] - REST_JOINTS[ankle]
    return rest


def unknown(motion: Motion) -> Motion:
    """As out of a file that does not tell whose legs it is of."""
    return dataclasses.replace(motion, detected=Detected())


@pytest.fixture(scope="module")
def walk() -> Motion:
    return unknown(rounds_of(built_in_motion("WALK"), STEPS // 2))


def slip(walk: Motion, factor: float, rest: np.ndarray) -> float:
    """Metres that the ball of a foot slides in a step, over the frames in which it stands for its own walker."""
    own = walk.joints()[:, BALLS]
    stands = np.linalg.norm(np.diff(own, axis=0), axis=-1) * walk.fps < 0.05
    moved = scale_places(walk, factor)
    balls = joint_positions(moved.rotations, moved.translations, rest)[:, BALLS]
    return float(np.linalg.norm(np.diff(balls[..., [0, 2]], axis=0), axis=-1)[stands].sum() / STEPS)


@pytest.mark.parametrize("legs", [0.85, 1.15, 1.3])
def test_feet_slide_a_third_as_far_or_less_once_the_way_fits_the_legs(walk, legs):
    rest = longer_legs(legs)
    factor = stride_ratio(walk, rest)
    assert factor == pytest.approx(legs, abs=0.03)
    before, after = slip(walk, 1.0, rest), slip(walk, factor, rest)
    assert before > 0.03
    assert after < before / 3


def test_a_motion_that_fits_is_left_alone(walk):
    assert stride_ratio(walk, REST_JOINTS) == 1.0


def test_lengths_of_an_average_person_need_no_guess(walk):
    average = dataclasses.replace(walk, detected=Detected(average_legs=True))
    assert stride_ratio(average, longer_legs(1.15)) == pytest.approx(1.15)


@pytest.mark.parametrize("name", ["IDLE", "WAVE"])
def test_a_motion_in_place_gives_no_stride(name):
    assert stride_ratio(unknown(rounds_of(built_in_motion(name), 4)), longer_legs(1.15)) is None


def test_two_steps_are_enough():
    walk = unknown(built_in_motion("WALK"))
    up_and_down_and_aside = np.abs(np.diff(walk.translations[:, :2], axis=0)).sum()
    assert up_and_down_and_aside < 0.4, "less than tells: the way is on the floor"
    assert stride_ratio(walk, longer_legs(1.15)) == pytest.approx(1.15, abs=0.05)


def test_skaters_and_walkers_on_treadmills_slide_on_purpose(walk):
    still = np.tile(np.eye(3), (len(walk), 24, 1, 1))
    assert stride_ratio(dataclasses.replace(walk, rotations=still), longer_legs(1.15)) is None
    assert stride_ratio(scale_places(walk, 0.0), longer_legs(1.15)) is None
    assert stride_ratio(scale_places(walk, 4.0), longer_legs(1.15)) is None


def test_a_fast_camera_that_trembles_by_a_millimetre_gives_nearly_the_same():
    walk = unknown(resample(rounds_of(built_in_motion("WALK"), STEPS // 2), 120.0))
    shake = np.random.default_rng(0).normal(0, 0.001, walk.translations.shape)
    shaken = dataclasses.replace(walk, translations=walk.translations + shake)
    assert stride_ratio(shaken, longer_legs(1.15)) == pytest.approx(1.15, abs=0.04)


@pytest.mark.parametrize(("fit_stride", "way"), [(True, 1.15), (False, 1.0)])
def test_an_amass_walk_on_longer_legs_goes_as_far_as_they_step(saved_scene, tmp_path, walk, fit_stride, way):
    write_amass(tmp_path / "walk.npz", walk, np.zeros(10))
    armature = build_armature("long", points_to_blender(longer_legs(1.15)))
    saved_scene.scene.collection.objects.link(armature)
    how = Placement(fit_stride=fit_stride)
    _, last = place_motion(saved_scene, armature, read_motion(tmp_path / "walk.npz"), how)
    ends = []
    for frame in (1, int(last)):
        saved_scene.scene.frame_set(frame)
        ends.append(np.array(armature.pose.bones["pelvis"].head))
    assert np.linalg.norm((ends[1] - ends[0])[:2]) == pytest.approx(way * STEPS / 2 * 1.28, rel=0.03)
