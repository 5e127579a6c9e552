"""Poses from users' files."""

import json
import math

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyPose
from primdiffusion.body.pose_file import pose_from_numbers, read_pose
from support.errors import refused

THETA = np.linspace(-1, 1, 72).astype(np.float32)


def assert_same(pose: BodyPose, theta=THETA, translation=(0.0, 0.0, 0.0)):
    expected = BodyPose.from_axis_angle(torch.as_tensor(theta))
    assert torch.allclose(pose.joint_rotation, expected.joint_rotation, atol=1e-6)
    assert torch.allclose(pose.translation, torch.tensor(translation))


def test_a_list_of_72_rows_of_3_and_an_object_are_the_same_pose(tmp_path):
    for content in (THETA.tolist(), THETA.reshape(24, 3).tolist(), {"pose": THETA.tolist()}):
        path = tmp_path / "pose.json"
        path.write_text(json.dumps(content))
        assert_same(read_pose(path))


def test_a_translation_comes_along(tmp_path):
    path = tmp_path / "pose.json"
    path.write_text(json.dumps({"pose": THETA.tolist(), "translation": [1, 2, 3]}))
    assert_same(read_pose(path), translation=(1.0, 2.0, 3.0))


@pytest.mark.parametrize(
    "content", [[1, 2, 3], {"theta": None}, {"pose": "up"}, {}, [[0, 0, 0]] * 23, [math.nan] * 72, None, {"pose": []}]
)
def test_numbers_that_are_no_pose_are_rejected_by_name(content):
    with refused(ValueError, "my pose"):
        pose_from_numbers(content, "my pose")


def test_a_frame_beyond_the_end_is_rejected(tmp_path):
    path = tmp_path / "one.npz"
    np.savez(path, poses=np.zeros((2, 72)))
    with refused(ValueError, "one.npz"):
        read_pose(path, frame=2)
