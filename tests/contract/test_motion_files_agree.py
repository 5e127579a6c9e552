"""Files of poses mean the same to the backend and to the extension."""

from pathlib import Path

import numpy as np
import pytest
import torch
from blender_primdiffusion.formats.poses import files
from blender_primdiffusion.formats.poses.rigs import RIGS
from blender_primdiffusion.formats.poses.rotation import from_axis_angle
from primdiffusion.body.model import read_motion, read_pose
from support.errors import refused

FRAMES = 4
RNG = np.random.default_rng(1)
WHOLE = RNG.normal(0, 0.3, (FRAMES, 165))
MOVE = RNG.normal(0, 1, (FRAMES, 3))
MATRICES = from_axis_angle(WHOLE[:, :72].reshape(FRAMES, 24, 3))


def lying(turn: tuple[float, float, float], numbers: int) -> np.ndarray:
    """Poses that stand where another axis than y is up."""
    given = np.array(WHOLE[:, :numbers])
    given[:, :3] = np.array(turn) + RNG.normal(0, 0.05, (FRAMES, 3))
    return given


FILES = {
    "amass_smpl.npz": {"poses": lying((np.pi / 2, 0, 0), 72), "trans": MOVE, "mocap_framerate": np.array(120.0)},
    "amass_smplh_without_a_rate.npz": {"poses": lying((np.pi / 2, 0, 0), 156), "trans": MOVE},
    "amass_smplx_y_up.npz": {"poses": WHOLE, "trans": MOVE, "mocap_frame_rate": np.array(30.0)},
    "amass_x_up.npz": {"poses": lying((0, 0, -np.pi / 2), 156), "trans": MOVE},
    "amass_minus_z_up.npz": {"poses": lying((-np.pi / 2, 0, 0), 156), "trans": MOVE},
    "amass_upside_down.npz": {"poses": lying((np.pi, 0, 0), 72), "trans": MOVE},
    "smplx_by_parts.npz": {"root_orient": WHOLE[:, :3], "pose_body": WHOLE[:, 3:66], "trans": MOVE},
    "parts.npz": {"global_orient": WHOLE[:, :3], "body_pose": WHOLE[:, 3:72], "transl": MOVE},
    "without_root.npz": {"body_pose": WHOLE[:, 3:72]},
    "no_hands.npz": {"poses": WHOLE[:, :66]},
    "whole.npz": {"fullpose": WHOLE, "transl": MOVE[:1]},
    "matrices.npz": {"poses": MATRICES, "transl": MOVE},
    "matrices_by_parts.npz": {"global_orient": MATRICES[:, 0], "body_pose": MATRICES[:, 1:]},
    "matrices_with_a_root_of_one_joint.npz": {"global_orient": MATRICES[:, :1], "body_pose": MATRICES[:, 1:22]},
}


def written(folder: Path, name: str) -> Path:
    np.savez(folder / name, **FILES[name])
    return folder / name


@pytest.mark.parametrize("name", FILES)
def test_both_programs_read_the_same_motion(tmp_path, name):
    path = written(tmp_path, name)
    ours, theirs = read_motion(path), files.read_motion(path)
    assert np.allclose(ours.joint_rotation.numpy(), theirs.rotations, atol=1e-5)
    assert np.allclose(ours.translation.numpy(), theirs.translations, atol=1e-5)


def test_matrices_are_not_taken_for_axis_angle_numbers(tmp_path):
    path = written(tmp_path, "matrices.npz")
    assert np.allclose(read_pose(path, frame=1).joint_rotation.numpy(), MATRICES[1], atol=1e-6)


def test_matrices_that_are_no_rotations_are_refused_by_both(tmp_path):
    stretched = np.array(MATRICES)
    stretched[1, 16] *= 1.1
    np.savez(tmp_path / "a.npz", poses=stretched)
    for reader in (files.read_motion, read_motion):
        with refused(ValueError, "a.npz", "left_shoulder", "frame 1"):
            reader(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["amass_smplh_without_a_rate.npz", "no_hands.npz", "amass_smpl.npz"])
def test_a_single_pose_has_the_joints_of_the_motion(tmp_path, name):
    path = written(tmp_path, name)
    theirs = torch.from_numpy(files.read_motion(path).rotations[2]).float()
    assert torch.allclose(read_pose(path, frame=2).joint_rotation, theirs, atol=1e-5)


def test_the_manual_lists_every_rig_that_is_known_by_its_bones():
    page = (Path(__file__).parents[2] / "docs" / "manual" / "motion.md").read_text(encoding="utf-8")
    assert [rig for rig in RIGS if rig != "SMPL, short" and rig not in page] == []
