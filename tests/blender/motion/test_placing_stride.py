"""Motions of other people on longer and shorter legs: how far feet slide that stand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.files import read_motion, write_amass
from blender_primdiffusion.formats.poses.motion import Detected, Motion
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS, joint_positions

from blender_primdiffusion.motion.placing import (
    Placement,
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
