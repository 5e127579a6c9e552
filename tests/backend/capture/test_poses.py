"""Poses to capture people in."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.poses import built_in_poses, choose_poses
from primdiffusion.formats import capture_layout
from primdiffusion.formats.regular_files import FileError
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.pose_file import read_motion
from support.errors import refused

THETA = np.random.default_rng(0).uniform(-0.5, 0.5, (5, 72))


def assert_turns(pose: BodyPose, theta=THETA) -> None:
    expected = axis_angle_to_matrix(torch.from_numpy(theta.reshape(len(theta), 24, 3))).float()
    assert torch.allclose(pose.joint_rotation, expected, atol=1e-6)


def joints(pose: BodyPose) -> np.ndarray:
    return default_body().shape(torch.zeros(1)).pose(pose).joints[..., :3, 3].numpy()


def test_frame_0_of_the_built_in_poses_is_near_t_and_all_differ():
    poses = built_in_poses()
    places = joints(poses)
    assert len(places) == 20
    wrist, shoulder = places[0, 20], places[0, 16]
    assert wrist[0] - shoulder[0] > 0.4  # arms out,
    assert 0.02 < shoulder[1] - wrist[1] < 0.3  # a little below level
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1).mean(-1)
    assert apart[~np.eye(20, dtype=bool)].min() > 0.03


def test_every_form_of_file_is_the_same_motion(tmp_path):
    np.savez(tmp_path / "a.npz", poses=THETA, trans=np.ones((5, 3)), gender="neutral")
    np.savez(tmp_path / "b.npz", global_orient=THETA[:, :3], body_pose=THETA[:, 3:], transl=np.ones((5, 3)))
    np.save(tmp_path / "c.npy", THETA)
    np.save(tmp_path / "d.npy", THETA.reshape(5, 24, 3))
    (tmp_path / "e.json").write_text(json.dumps({"poses": THETA.tolist(), "trans": [1, 1, 1]}))
    (tmp_path / "f.json").write_text(json.dumps(THETA.tolist()))
    for path in sorted(tmp_path.iterdir()):
        assert_turns(read_motion(path))
    assert torch.equal(read_motion(tmp_path / "b.npz").translation, torch.ones(5, 3))


def test_a_pickled_dictionary_is_the_same_motion_and_nothing_else_is_loaded(tmp_path):
    theta = np.random.default_rng(2).normal(0, 0.3, (3, 72))
    parts = {"global_orient": theta[:, :3], "body_pose": theta[:, 3:], "transl": np.ones((3, 3)), "betas": np.ones(10)}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(parts))
    np.savez(tmp_path / "a.npz", **parts)
    pickled, plain = (read_motion(tmp_path / name) for name in ("a.pkl", "a.npz"))
    assert torch.equal(pickled.joint_rotation, plain.joint_rotation)
    assert torch.equal(pickled.translation, plain.translation)
    for content in (pickle.dumps([1]), pickle.dumps(Path), b"nothing", pickle.dumps({"body_pose": "x"})):
        (tmp_path / "b.pkl").write_bytes(content)
        with refused(FileError, "b.pkl") as caught:
            read_motion(tmp_path / "b.pkl")
        assert "body model" not in str(caught.value)


def test_one_pose_is_a_motion_of_one_frame(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"pose": THETA[0].tolist()}))
    np.save(tmp_path / "b.npy", THETA[0].reshape(24, 3))
    for path in tmp_path.iterdir():
        assert_turns(read_motion(path), THETA[:1])


def test_a_captures_parameters_are_a_motion(tmp_path):
    capture_layout.write_smpl(tmp_path, THETA[:, :3], THETA[:, 3:], np.zeros(10), np.zeros((5, 3)))
    assert_turns(read_motion(tmp_path / capture_layout.SMPL_FOLDER / capture_layout.SMPL_PLAIN_FILE))


@pytest.mark.parametrize("rate", [{}, {"mocap_framerate": 120.0}])
def test_amass_files_are_turned_upright_with_and_without_a_frame_rate(tmp_path, rate):
    poses = np.zeros((1, 156))
    poses[0, 0] = np.pi / 2  # upright where z is up
    np.savez(tmp_path / "a.npz", poses=poses, trans=[[1.0, 2, 3]], **rate)
    motion = read_motion(tmp_path / "a.npz")
    assert torch.allclose(motion.joint_rotation[0, 0], torch.eye(3), atol=1e-6)
    pelvis = default_body().shape(torch.zeros(1)).joints[0]
    placed = torch.tensor([1.0, 2, 3]) + pelvis
    assert torch.allclose(motion.translation + pelvis, torch.stack([placed[0], placed[2], -placed[1]]), atol=1e-6)


@pytest.mark.parametrize("numbers", [66, 156, 165])
def test_fingers_are_not_taken_for_smpls_hand_joints(tmp_path, numbers):
    poses = np.full((5, numbers), 0.7)
    poses[:, :66] = THETA[:, :66]
    np.save(tmp_path / "a.npy", poses)
    assert_turns(read_motion(tmp_path / "a.npy"), np.pad(THETA[:, :66], ((0, 0), (0, 6))))


@pytest.mark.parametrize(("moves", "fault"), [([[0, 0, 0]] * 4, "5 frames"), ([[0, 0, float("nan")]] * 5, "NaN")])
def test_translations_that_do_not_fit_are_rejected_by_name(tmp_path, moves, fault):
    (tmp_path / "a.json").write_text(json.dumps({"poses": THETA.tolist(), "trans": moves}))
    with refused(FileError, "a.json", fault):
        read_motion(tmp_path / "a.json")


@pytest.mark.parametrize(
    "content",
    ["{}", "[[1, 2]]", "[]", json.dumps([float("nan")] * 72), '{"poses": "up"}'],
)
def test_json_without_poses_is_rejected_by_name(tmp_path, content):
    (tmp_path / "a.json").write_text(content)
    with refused(FileError, "a.json"):
        read_motion(tmp_path / "a.json")


def test_few_poses_are_chosen_to_differ_and_the_choice_is_the_seeds(tmp_path):
    still = np.zeros((50, 72))
    still[:, 3 * 16 + 2] = -1.2 + np.linspace(0, 0.01, 50)  # fifty frames of the same
    still[17, 3 * 18 + 1] = -2.0  # and one with a bent arm
    np.savez(tmp_path / "a.npz", poses=still)
    chosen = choose_poses([read_motion(tmp_path / "a.npz")], 3, seed=0)
    assert torch.equal(chosen.joint_rotation[0], built_in_poses().joint_rotation[0])
    assert any(
        torch.allclose(pose, read_motion(tmp_path / "a.npz").joint_rotation[17]) for pose in chosen.joint_rotation
    )
    assert torch.equal(chosen.joint_rotation, choose_poses([read_motion(tmp_path / "a.npz")], 3, seed=0).joint_rotation)


def test_more_poses_than_there_are_are_rejected():
    with refused(ValueError, "there are 20"):
        choose_poses([], 21, 0)
    with refused(ValueError, "0 poses"):
        choose_poses([], 0, 0)
