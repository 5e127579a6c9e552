"""Captures read back, ours and in the released layout, whole and damaged."""

import json
import shutil
import struct
import zlib

import numpy as np
import pytest
import torch
from PIL import Image
from primdiffusion import cli
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.people_files import read_person
from primdiffusion.capture.reader import open_captures
from primdiffusion.capture.render import set_up_capture
from primdiffusion.capture.sheet import body_joints, draw_sheet, reprojection_error
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats import capture_layout
from support.errors import refused

NAME = "person_000000"
_MIRRORED = {"K": np.eye(3).tolist(), "R": np.diag([-1.0, 1, 1]).tolist(), "T": [0, 0, 3]}
REFLECTION = json.dumps({f"camera{number:04d}": _MIRRORED for number in range(4)}).encode()


def test_a_view_comes_back_as_it_was_drawn(root):
    captures = open_captures(root)
    assert captures.subjects == (NAME, "person_000001")
    subject = captures.subject(NAME)
    poses = BodyPose.from_axis_angle(torch.from_numpy(subject.smpl.theta), torch.from_numpy(subject.smpl.translation))
    sitting = set_up_capture(read_person(root.parent / "people" / NAME / "person.glb"), poses, subject.views)
    for frame, camera in ((0, 0), (2, 3)):
        view = captures.view(NAME, frame, camera)
        shot = sitting.person.posed(sitting.skinning[frame])(subject.views[camera], 3)
        assert (view.camera.width, view.camera.height) == (32, 32)
        np.testing.assert_allclose(view.mask.numpy() / 255, shot.alpha, atol=0.003)
        np.testing.assert_allclose(view.depth.numpy(), np.where(np.isfinite(shot.depth), shot.depth, 0), atol=0.00013)
        np.testing.assert_allclose(view.normal.numpy(), shot.normal, atol=0.005)
        assert np.array_equal(view.part.numpy(), shot.part)
        assert torch.allclose(view.pose.joint_rotation, poses.joint_rotation[frame], atol=1e-5)
        assert view.image.shape == (32, 32, 3)
        assert subject.smpl.betas.shape == (10,)


def test_depth_and_camera_put_points_on_the_persons_surface(root):
    """Independent of joints: pixels lifted by depth lie on the box about the wrist that the part mask shows."""
    captures = open_captures(root)
    joints = body_joints(captures.subject(NAME), default_body())
    for camera in range(4):
        view = captures.view(NAME, 1, camera)
        seen = view.part == 1 + 20  # left wrist
        if not seen.any():
            continue
        origin, rays = view.camera.rays()
        along = rays @ view.camera.world_to_camera[2, :3]
        points = origin + rays * (view.depth / along)[..., None]
        apart = (points[seen] - torch.from_numpy(joints[1, 20]).float()).norm(dim=-1)
        assert apart.max() < 0.1 * 3**0.5 + 0.001
        assert apart.min() > 0.1 - 0.001


def test_joints_project_to_where_the_file_says(root):
    for name in open_captures(root).subjects:
        subject = open_captures(root).subject(name)
        assert reprojection_error(subject) < 1e-3
        with np.load(subject.folder / "joints.npz") as noted:
            np.testing.assert_allclose(body_joints(subject, default_body()), noted["world"], atol=1e-5)


def test_cameras_as_far_as_no_camera_is_are_rejected(root):
    path = root / NAME / "cameras.json"
    cameras = json.loads(path.read_text())
    cameras["camera0001"]["K"][0][2] = 2.0**63
    path.write_text(json.dumps(cameras))
    with refused(FileError, "camera0001"):
        open_captures(root).view(NAME, 1, 2)


def as_released(root):
    """What the authors' files are: no dataset.json, no plain twin, no other passes."""
    (root / capture_layout.DATASET_FILE).unlink()
    for name in (root / capture_layout.LIST_FILE).read_text().split():
        for path in (root / name).iterdir():
            if path.name not in ("img", "mask", "cameras.json", capture_layout.SMPL_FOLDER):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        (root / name / capture_layout.SMPL_FOLDER / capture_layout.SMPL_PLAIN_FILE).unlink()


def test_the_released_layout_is_read_through_its_pickle(root):
    ours = open_captures(root).view(NAME, 1, 2)
    as_released(root)
    captures = open_captures(root)
    assert captures.passes == ("img", "mask")
    theirs = captures.view(NAME, 1, 2)
    assert torch.equal(ours.image, theirs.image)
    assert torch.equal(ours.mask, theirs.mask)
    assert torch.equal(ours.pose.joint_rotation, theirs.pose.joint_rotation)
    assert torch.equal(ours.camera.world_to_camera, theirs.camera.world_to_camera)
    assert theirs.depth is None


def test_a_pickle_that_would_run_code_is_rejected(root, tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "trapped"), "w"))

    as_released(root)
    path = root / NAME / capture_layout.SMPL_FOLDER / capture_layout.SMPL_FILE
    np.savez(path, smpl=np.array({"global_orient": Trap()}, dtype=object))
    with refused(FileError, "open"):
        open_captures(root).subject(NAME)
    assert not (tmp_path / "trapped").exists()


@pytest.mark.parametrize("content", [{}, {"global_orient": "up"}, [1, 2], {"global_orient": np.zeros((3, 3))}])
def test_a_pickle_without_parameters_is_rejected_by_name(root, content):
    as_released(root)
    path = root / NAME / capture_layout.SMPL_FOLDER / capture_layout.SMPL_FILE
    np.savez(path, smpl=np.array(content, dtype=object))
    with refused(FileError, capture_layout.SMPL_FILE):
        open_captures(root).subject(NAME)


@pytest.mark.parametrize("name", ["../../etc", "/etc", ".ssh", "a/b", "..", "a b"])
def test_a_list_that_names_folders_outside_is_rejected(root, name):
    (root / capture_layout.LIST_FILE).write_text(f"{NAME}\n{name}\n")
    with refused(FileError, capture_layout.LIST_FILE):
        open_captures(root)


@pytest.mark.parametrize(
    ("file", "content", "why"),
    [
        ("mask/camera0002/0001.png", None, "missing"),
        ("mask/camera0002/0001.png", "small", "5 x 5 pixels, its camera 32 x 32"),
        ("depth/camera0002/0001.png", b"cut", "not a complete image"),
        ("cameras.json", b"[1, 2]", "not a list of cameras"),
        ("cameras.json", b'{"camera0000": {"K": [[1]]}}', "not a list of cameras"),
        ("cameras.json", b"{}", "contains no camera"),
        ("cameras.json", REFLECTION, "camera0000: R is not a rotation"),
    ],
)
def test_wrong_and_missing_files_are_named(root, file, content, why):
    path = root / NAME / file
    path.unlink()
    if content == "small":
        Image.new("L", (5, 5)).save(path)
    elif content:
        path.write_bytes(content)
    with refused((FileError, FileNotFoundError), str(path), why):
        open_captures(root).view(NAME, 1, 2)


def test_no_captures_are_no_captures(tmp_path):
    with refused(FileNotFoundError, "path"):
        open_captures(tmp_path / "nowhere")
    with refused(FileNotFoundError, "finished"):
        open_captures(tmp_path)


def test_frames_and_cameras_that_are_not_there_are_rejected(root):
    for frame, camera in ((3, 0), (0, 4), (-1, 0)):
        with refused(IndexError, "3 frames", "4 cameras"):
            open_captures(root).view(NAME, frame, camera)


def test_info_and_sheet_say_and_show_what_is_there(root, tmp_path, capsys):
    cli.main(["captures", "info", str(root)])
    about = json.loads(capsys.readouterr().out)
    assert [about[key] for key in ("subjects", "frames", "cameras", "size")] == [2, 3, 4, [32, 32]]
    assert draw_sheet(open_captures(root), tmp_path / "sheet.png", rows=6, columns=3, size=64) < 1e-3
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.size == (3 * 64, 6 * 64)
        assert np.asarray(sheet).any(-1).mean() > 0.02


@pytest.mark.parametrize("mode", ["RGB", "LA", "RGBA"])
def test_depth_with_several_channels_is_rejected(root, mode):
    path = capture_layout.picture_path(root / NAME, "depth", 0, 0)
    Image.new(mode, Image.open(path).size).save(path)
    with refused(FileError, "channels"):
        open_captures(root).view(NAME, 0, 0)


def claim_pixels(root, width, height, padding=0):
    """Let all passes of camera 0 claim a size; nothing is in the files that could be decoded to it."""
    path = root / capture_layout.DATASET_FILE
    passes = ["img", "mask", "depth", "part"]
    path.write_text(json.dumps({**json.loads(path.read_text()), "passes": passes}))
    for kind in passes:
        header = struct.pack(">IIBBBBB", width, height, 8, 2 if kind == "img" else 0, 0, 0, 0)
        chunks = ((b"IHDR", header), (b"IDAT", b""))
        content = b"".join(
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
            for name, data in chunks
        )
        for frame in range(3):
            picture = capture_layout.picture_path(root / NAME, kind, 0, frame)
            picture.write_bytes(b"\x89PNG\r\n\x1a\n" + content + bytes(padding))


def test_passes_of_a_view_are_limited_together_before_any_is_decoded(root):
    claim_pixels(root, 6400, 6400)  # each alone would be decoded
    with refused(FileError, "6400 x 6400 pixels") as error:
        open_captures(root).view(NAME, 0, 0)
    assert str(root / NAME) in str(error.value)
    claim_pixels(root, 6400, 6400, padding=1_500_000)
    with refused(FileError):
        open_captures(root).view(NAME, 0, 0)
    claim_pixels(root, 5700, 5700)
    with refused(FileError):
        open_captures(root).view(NAME, 0, 0)


def test_colour_and_mask_are_those_of_the_files(root):
    subject = open_captures(root).subject(NAME)
    rgba = subject.rgba(1, 2)
    assert np.array_equal(rgba[..., :3], subject.picture("img", 1, 2))
    assert np.array_equal(rgba[..., 3], subject.picture("mask", 1, 2))


@pytest.mark.parametrize("labels", [(1, 1), (3, 15)])
@pytest.mark.parametrize("mode", ["L", "P"])
def test_in_masks_of_labels_the_person_is_what_is_not_0(root, labels, mode):
    path = root / NAME / "mask/camera0002/0001.png"
    covered = np.asarray(Image.open(path)) > 127
    values = np.where(covered, labels[0], 0).astype(np.uint8)
    values[:, 16:] = np.where(covered[:, 16:], labels[1], 0)
    image = Image.fromarray(values, mode)
    if mode == "P":
        image.putpalette([channel for number in range(16) for channel in (8 * number, 0, 90 * (number > 0))])
    image.save(path)
    found = open_captures(root).view(NAME, 1, 2).mask.numpy()
    assert np.array_equal(found, np.where(covered, 255, 0))
