"""Poses of SAM 3D Body, on MHR's rig."""

import json

import numpy as np
import pytest
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.poses.files import read_motion
from primdiffusion.formats.poses.mhr import JOINTS, REST
from support.errors import refused
from support.mhr_files import mhr_arrays, write_mhr

RNG = np.random.default_rng(5)
THETA = RNG.normal(0, 0.4, (3, 24, 3))
THETA[:, [JOINT_NAMES.index("left_hand"), JOINT_NAMES.index("right_hand")]] = 0  # MHR has fingers there
MOVE = RNG.normal(0, 1, (3, 3))


def changed(**others):
    return {**mhr_arrays(THETA, MOVE), **others}


def test_the_joints_are_mhrs_127():
    assert len(JOINTS) == len(set(JOINTS)) == 127
    assert set(REST) <= set(JOINTS)
    assert (JOINTS[1], JOINTS[37], JOINTS[110], JOINTS[-1]) == ("root", "c_spine3", "c_neck", "c_head_null")


@pytest.mark.parametrize("ending", ["npz", "json", "pkl"])
def test_our_pose_written_as_mhr_reads_back_the_same(tmp_path, ending):
    motion = read_motion(write_mhr(tmp_path / f"a.{ending}", mhr_arrays(THETA, MOVE)))
    np.testing.assert_allclose(motion.axis_angle(), THETA, atol=1e-4)
    np.testing.assert_allclose(motion.translations, MOVE, atol=1e-5)
    assert (motion.detected.rig, motion.detected.up, len(motion.detected.bones)) == ("MHR", "y", 22)


def test_one_picture_is_one_frame(tmp_path):
    one = {key: array[0] for key, array in mhr_arrays(THETA, MOVE).items()}
    motion = read_motion(write_mhr(tmp_path / "a.npz", one))
    np.testing.assert_allclose(motion.axis_angle(), THETA[:1], atol=1e-4)


def test_joints_in_another_order_are_found_by_their_names(tmp_path):
    order = RNG.permutation([JOINTS.index(name) for name in REST])
    arrays = {**mhr_arrays(THETA, MOVE), "joint_names": np.array(JOINTS)[order]}
    for key in ("pred_global_rots", "pred_joint_coords"):
        arrays[key] = arrays[key][:, order]
    for ending in ("npz", "json"):
        motion = read_motion(write_mhr(tmp_path / f"a.{ending}", arrays))
        np.testing.assert_allclose(motion.axis_angle(), THETA, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"pred_global_rots": np.tile(np.eye(3), (3, 70, 1, 1))}, "127"),
        ({"pred_global_rots": np.zeros((3, 127, 3, 3))}, "root"),
        ({"pred_global_rots": np.full((3, 127, 3, 3), np.nan)}, "NaN"),
        ({"pred_joint_coords": np.zeros((2, 127, 3))}, "2 of pred_joint_coords"),
        ({"pred_joint_coords": np.zeros((3, 127, 3))}, "no human"),
        ({"pred_joint_coords": np.array(["a"])}, "instead of numbers"),
        ({"pred_cam_t": np.zeros((3, 2))}, "pred_cam_t"),
        ({"joint_names": np.array(JOINTS)[:5]}, "c_spine0"),
        ({"joint_names": np.zeros(127)}, "joint_names"),
        ({"fps": np.array(1e5)}, "frames per second"),
    ],
)
def test_what_is_no_pose_of_mhr_is_one_sentence(tmp_path, change, text):
    path = write_mhr(tmp_path / "a.npz", changed(**change))
    with refused(FileError, "a.npz", text):
        read_motion(path)


@pytest.mark.parametrize("key", ["pred_global_rots", "pred_joint_coords"])
def test_parameters_without_joints_are_refused_with_what_to_save(tmp_path, key):
    arrays = mhr_arrays(THETA, MOVE)
    del arrays[key]
    for ending in ("npz", "json", "pkl"):
        with refused(FileError, f"a.{ending}", "pred_global_rots", "pred_joint_coords"):
            read_motion(write_mhr(tmp_path / f"a.{ending}", arrays))


def test_of_several_humans_one_is_chosen(tmp_path):
    people = [{key: array.tolist() for key, array in mhr_arrays(THETA, MOVE + n).items()} for n in (0, 1)]
    (tmp_path / "a.json").write_text(json.dumps(people))
    motion = read_motion(tmp_path / "a.json", person="1")
    assert motion.detected.people == ("0", "1")
    np.testing.assert_allclose(motion.translations, MOVE + 1, atol=1e-3)
