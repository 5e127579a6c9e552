"""Camera files that `captures export` writes from finished captures."""

import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_scenes import captured
from primdiffusion.body.model import BodyPose, default_body, read_motion
from primdiffusion.capture.camera_files import export_cameras
from primdiffusion.capture.poses import built_in_poses, choose_poses
from primdiffusion.capture.reader import open_captures
from primdiffusion.cli import run
from primdiffusion.files.regular_files import FileError
from scipy.spatial.transform import Rotation
from support.capture_files import faults
from support.errors import refused


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    root = captured(tmp_path_factory.mktemp("captures"), people=2, frames=2, passes=("img", "mask"))
    run(["captures", "export", str(root)])
    return root


def test_colmaps_quaternions_nerfs_matrices_and_opencvs_arrays_are_the_same_cameras(exported):
    captures = open_captures(exported)
    for name in captures.subjects:
        subject, views = exported / name, captures.subject(name).views
        lines = (subject / "colmap/0001/images.txt").read_text().splitlines()[1::2]
        frames = json.loads((subject / "nerf/0001/transforms.json").read_text())["frames"]
        arrays = np.load(subject / "opencv/cameras.npz")
        for i, (view, line, frame) in enumerate(zip(views, lines, frames, strict=True)):
            _, w, x, y, z, *translation, _, picture = line.split()
            rotation = Rotation.from_quat([float(value) for value in (x, y, z, w)]).as_matrix()
            assert float(w) >= 0
            assert np.allclose(rotation, view.rotation, atol=1e-12)
            assert np.allclose(np.array(translation, float), view.translation)
            assert picture == f"camera{i:04d}/0001.jpg"
            assert (subject / "img" / picture).is_file()
            assert (subject / "nerf/0001" / frame["file_path"]).resolve() == (subject / "img" / picture).resolve()
            to_world = np.array(frame["transform_matrix"])
            in_opengl = np.linalg.inv(to_world) @ [0.3, 0.2, 0.1, 1]
            assert np.allclose(in_opengl[:3] * (1, -1, -1), view.rotation @ [0.3, 0.2, 0.1] + view.translation)
            projection = view.intrinsics @ np.c_[view.rotation, view.translation]
            assert np.array_equal(arrays["K"][i] @ np.c_[arrays["R"][i], arrays["T"][i]], projection)


def test_an_export_leaves_captures_whole_and_a_second_one_leaves_them_as_they_are(exported):
    assert not faults(exported)
    before = {path: path.stat().st_mtime_ns for path in exported.rglob("*")}
    run(["captures", "export", str(exported), "--projects", "colmap"])
    assert {path: path.stat().st_mtime_ns for path in exported.rglob("*")} == before


def test_captures_without_colour_and_links_out_of_them_are_refused(exported, tmp_path):
    captures = open_captures(exported)
    captures.about["passes"].remove("img")  # pyright: ignore
    with refused(ValueError, str(exported), "pass img"):
        list(export_cameras(captures, ("nerf",)))
    root, outside = tmp_path / "captures", tmp_path / "outside"
    shutil.copytree(exported, root)
    outside.mkdir()
    shutil.rmtree(root / captures.subjects[0] / "nerf")
    (root / captures.subjects[0] / "nerf").symlink_to(outside)
    with refused(FileError, "nerf"):
        list(export_cameras(open_captures(root), ("nerf",)))
    assert not list(outside.iterdir())


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
    bent = read_motion(tmp_path / "a.npz").joint_rotation[17]
    assert any(torch.allclose(pose, bent) for pose in chosen.joint_rotation)
    assert torch.equal(chosen.joint_rotation, choose_poses([read_motion(tmp_path / "a.npz")], 3, seed=0).joint_rotation)


def test_more_poses_than_there_are_are_rejected():
    with refused(ValueError, "there are 20"):
        choose_poses([], 21, 0)
    with refused(ValueError, "0 poses"):
        choose_poses([], 0, 0)
