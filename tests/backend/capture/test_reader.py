"""Captures read back, ours and in the released layout, whole and damaged."""

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.people_files import read_person
from primdiffusion.capture.reader import body_joints, open_captures
from primdiffusion.capture.render import set_up_capture
from primdiffusion.files.picture_files import DEPTH_UNIT
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats import capture_layout
from support.errors import refused

NAME = "person_000000"
PASSES = ("mask", "depth", "normal", "part")


def four_cameras(**changes: np.ndarray) -> bytes:
    camera = {"K": np.eye(3), "R": np.eye(3), "T": np.array([0, 0, 3])} | changes
    named = {f"camera{number:04d}": {key: values.tolist() for key, values in camera.items()} for number in range(4)}
    return json.dumps(named).encode()


def test_a_view_comes_back_as_it_was_drawn(root):
    captures = open_captures(root)
    assert captures.subjects == (NAME, "person_000001")
    subject = captures.subject(NAME)
    poses = BodyPose.from_axis_angle(torch.from_numpy(subject.smpl.theta), torch.from_numpy(subject.smpl.translation))
    sitting = set_up_capture(read_person(root.parent / "people" / NAME / "person.glb"), poses, subject.views)
    for frame, camera in ((0, 0), (2, 3)):
        view = subject.pictures(("img", *PASSES), frame, camera)
        shot = sitting.person.posed(sitting.skinning[frame])(subject.views[camera], 3)
        assert (subject.camera(camera).width, subject.camera(camera).height) == (32, 32)
        np.testing.assert_allclose(view["mask"] / 255, shot.alpha, atol=0.003)
        far = np.where(np.isfinite(shot.depth), shot.depth, 0)
        np.testing.assert_allclose(view["depth"] * DEPTH_UNIT, far, atol=0.00013)
        covered = view["normal"].any(-1)
        np.testing.assert_allclose(view["normal"][covered] / 127.5 - 1, shot.normal[covered], atol=0.005)
        assert np.array_equal(view["part"], shot.part)
        assert torch.allclose(subject.smpl.pose(frame).joint_rotation, poses.joint_rotation[frame], atol=1e-5)
        assert view["img"].shape == (32, 32, 3)
        assert subject.smpl.betas.shape == (10,)


def test_depth_and_camera_put_points_on_the_persons_surface(root):
    """Independent of joints: pixels lifted by depth lie on the box about the wrist that the part mask shows."""
    subject = open_captures(root).subject(NAME)
    joints = body_joints(subject, default_body())
    for camera in range(4):
        seen = subject.picture("part", 1, camera) == 1 + 20  # left wrist
        if not seen.any():
            continue
        origin, rays = subject.camera(camera).rays()
        along = rays @ subject.camera(camera).world_to_camera[2, :3]
        depth = torch.from_numpy(subject.picture("depth", 1, camera) * np.float32(DEPTH_UNIT))
        points = origin + rays * (depth / along)[..., None]
        apart = (points[torch.from_numpy(seen)] - torch.from_numpy(joints[1, 20]).float()).norm(dim=-1)
        assert apart.max() < 0.1 * 3**0.5 + 0.001
        assert apart.min() > 0.1 - 0.001


def test_joints_project_to_where_the_file_says(root):
    for name in open_captures(root).subjects:
        subject = open_captures(root).subject(name)
        with np.load(subject.folder / "joints.npz") as noted:
            for view, pixels in zip(subject.views, noted["pixel"], strict=True):
                np.testing.assert_allclose(view.project(noted["world"])[0], pixels, atol=1e-3)
            np.testing.assert_allclose(body_joints(subject, default_body()), noted["world"], atol=1e-5)


def as_released(root):
    """What the authors' files are: no dataset.json, no plain twin, no other passes."""
    (root / capture_layout.DATASET_FILE).unlink()
    for name in (root / capture_layout.LIST_FILE).read_text().split():
        for path in (root / name).iterdir():
            if path.name not in ("img", "mask", "cameras.json", capture_layout.SMPL_FOLDER):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        (root / name / capture_layout.SMPL_FOLDER / capture_layout.SMPL_PLAIN_FILE).unlink()


def test_the_released_layout_is_read_through_its_pickle(root):
    ours = open_captures(root).subject(NAME)
    as_released(root)
    captures = open_captures(root)
    assert captures.passes == ("img", "mask")
    theirs = captures.subject(NAME)
    assert np.array_equal(ours.rgba(1, 2), theirs.rgba(1, 2))
    assert np.array_equal(ours.smpl.theta, theirs.smpl.theta)
    assert torch.equal(ours.camera(2).world_to_camera, theirs.camera(2).world_to_camera)


@pytest.mark.parametrize("content", [{}, {"global_orient": "up"}, [1, 2], {"global_orient": np.zeros((3, 3))}])
def test_a_pickle_without_parameters_is_rejected_by_name(root, content):
    as_released(root)
    path = root / NAME / capture_layout.SMPL_FOLDER / capture_layout.SMPL_FILE
    np.savez(path, smpl=np.array(content, dtype=object))
    with refused(FileError, capture_layout.SMPL_FILE):
        open_captures(root).subject(NAME)


@pytest.mark.parametrize("name", ["../../etc", "/etc", "a b"])
def test_a_list_that_names_folders_outside_is_rejected(root, name):
    (root / capture_layout.LIST_FILE).write_text(f"{NAME}\n{name}\n")
    with refused(FileError, capture_layout.LIST_FILE):
        open_captures(root)


@pytest.mark.parametrize(
    ("file", "content", "why"),
    [
        ("mask/camera0002/0001.png", None, "missing"),
        ("mask/camera0002/0001.png", ("L", 5), "5 x 5 pixels, its camera 32 x 32"),
        ("depth/camera0002/0001.png", b"cut", "not a complete image"),
        ("depth/camera0002/0001.png", ("LA", 32), "channels"),
        ("cameras.json", b"[1, 2]", "contains no camera"),
        ("cameras.json", b'{"camera0000": {"K": [[1]]}}', "camera0000"),
        ("cameras.json", b"{}", "contains no camera"),
        ("cameras.json", four_cameras(R=np.diag([-1, 1, 1])), "R is not a rotation"),
        ("cameras.json", four_cameras(K=2.0**63 * np.eye(3)), "camera0000"),
    ],
)
def test_wrong_and_missing_files_are_named(root, file, content, why):
    path = root / NAME / file
    path.unlink()
    if isinstance(content, tuple):
        Image.new(content[0], (content[1],) * 2).save(path)
    elif content:
        path.write_bytes(content)
    with refused((FileError, FileNotFoundError), str(path), why):
        open_captures(root).subject(NAME).pictures(PASSES, 1, 2)


def test_no_captures_are_no_captures(tmp_path):
    with refused(FileNotFoundError, "path"):
        open_captures(tmp_path / "nowhere")
    with refused(FileNotFoundError, "finished"):
        open_captures(tmp_path)


@pytest.mark.parametrize(("mode", "labels"), [("L", (1, 1)), ("P", (3, 15))])
def test_in_masks_of_labels_the_person_is_what_is_not_0(root, labels, mode):
    path = root / NAME / "mask/camera0002/0001.png"
    covered = np.asarray(Image.open(path)) > 127
    values = np.where(covered, labels[0], 0).astype(np.uint8)
    values[:, 16:] = np.where(covered[:, 16:], labels[1], 0)
    image = Image.fromarray(values, mode)
    if mode == "P":
        image.putpalette([channel for number in range(16) for channel in (8 * number, 0, 90 * (number > 0))])
    image.save(path)
    found = open_captures(root).subject(NAME).picture("mask", 1, 2)
    assert np.array_equal(found, np.where(covered, 255, 0))
