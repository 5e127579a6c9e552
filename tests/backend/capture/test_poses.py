"""Poses to capture people in."""

import pickle
from pathlib import Path

import numpy as np
import torch
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.body.pose_file import read_motion
from primdiffusion.capture.poses import built_in_poses, choose_poses
from primdiffusion.files.regular_files import FileError
from support.errors import refused


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
