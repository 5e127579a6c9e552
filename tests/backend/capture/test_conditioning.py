"""Which pictures the encoder is given, and which captures it is not."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_scenes import box, captured, save_person, small_job
from PIL import Image
from primdiffusion.body.model import default_body
from primdiffusion.capture.conditioning import (
    captured_person,
    choose_subject,
    conditioning_views,
    default_betas,
    spread_cameras,
)
from primdiffusion.capture.reader import SmplParameters, Subject, open_captures
from primdiffusion.capture.render import render
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.formats.capture_layout import picture_path, write_npz, write_smpl
from primdiffusion.geometry.textured_mesh import TexturedMesh
from support.errors import refused

FIRST = "person_000000"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return captured(tmp_path_factory.mktemp("conditioning"), people=2, frames=2, passes=("img", "mask"))


@pytest.fixture
def folder(dataset, tmp_path):
    """A dataset to damage."""
    return shutil.copytree(dataset, tmp_path / "captures")


def ring(tmp_path, count: int, turn: float = 0.0) -> Subject:
    """Somebody who looks `turn` radians to their left, in a ring of cameras; camera 0 is at +z."""
    theta = np.zeros((1, 72), np.float32)
    theta[0, 1] = turn
    smpl = SmplParameters(theta, np.zeros((1, 3), np.float32), np.zeros(10, np.float32))
    return Subject(tmp_path, tuple(Rig("rings", count, (0.0,)).views(np.zeros(3), 1.0)), smpl)


@pytest.mark.parametrize(("turn", "front"), [(0.0, 0), (np.pi / 2, 2), (np.pi, 4)])
def test_one_camera_is_the_one_before_the_face(tmp_path, turn, front):
    assert spread_cameras(ring(tmp_path, 8, turn), 0, 1) == (front,)


def test_fewer_cameras_are_evenly_around_the_person(tmp_path):
    assert spread_cameras(ring(tmp_path, 8), 0, 2) == (0, 4)
    assert spread_cameras(ring(tmp_path, 8), 0, 4) == (0, 2, 4, 6)


def test_all_cameras_are_taken_where_there_are_no_more(tmp_path):
    assert spread_cameras(ring(tmp_path, 5), 0, 8) == (0, 1, 2, 3, 4)


def test_views_are_the_pictures_and_masks_of_the_cameras(dataset):
    captures = open_captures(dataset)
    views = conditioning_views(captures, FIRST, 1, (3, 1))
    assert views.rgba.shape == (2, 32, 32, 4)
    for row, camera in enumerate((3, 1)):
        subject = captures.subject(FIRST)
        assert np.array_equal(views.rgba[row], subject.rgba(1, camera))
        assert torch.allclose(views.camera.intrinsics[row], subject.camera(camera).intrinsics)
        assert torch.equal(views.camera.world_to_camera[row], subject.camera(camera).world_to_camera)
    assert torch.equal(views.pose.joint_rotation, captures.subject(FIRST).smpl.pose(1).joint_rotation)


def test_large_pictures_are_averaged_and_their_cameras_follow(dataset):
    captures = open_captures(dataset)
    small, whole = (conditioning_views(captures, FIRST, 0, (0,), side) for side in (8, 32))
    assert small.rgba.shape == (1, 8, 8, 4)
    averaged = whole.mask.float().unflatten(1, (8, 4)).unflatten(3, (8, 4)).mean((2, 4))
    assert (small.mask.float() - averaged).abs().max() <= 0.5
    assert torch.allclose(small.camera.intrinsics[0, :2] * 4, whole.camera.intrinsics[0, :2])


def test_a_subjects_own_folder_needs_no_name(dataset):
    captures, name = choose_subject(dataset / FIRST)
    assert name == FIRST
    assert captures.subjects == (FIRST,)
    assert captured_person(dataset / FIRST).subject == FIRST


def test_without_a_known_subject_the_nearest_are_named_first(dataset):
    with refused(ValueError, "person_000000", "person_000001"):
        choose_subject(dataset)
    with refused(ValueError, "person_00001", "person_000001", "person_000000"):
        choose_subject(dataset, "person_00001")


@pytest.mark.parametrize(("frame", "views", "why"), [(-1, 8, "-1"), (2, 8, "2"), (0, 0, "0 views")])
def test_frames_that_were_not_captured_and_no_views_are_rejected(dataset, frame, views, why):
    with refused(ValueError, why):
        captured_person(dataset, FIRST, frame, views)


def rewrite_betas(folder, betas) -> None:
    for path in (folder / FIRST / "outputs_re_fitting").iterdir():
        path.unlink()
    write_smpl(folder / FIRST, np.zeros((2, 3)), np.zeros((2, 69)), np.asarray(betas), np.zeros((2, 3)))


def test_a_rig_whose_joints_are_far_from_any_bodys_is_judged_by_the_body_fitted_to_it(folder):
    path = folder / FIRST / "joints.npz"
    with np.load(path) as noted:
        world = noted["world"]
    write_npz(path, world=world + np.float32([0, 0.1, 0]), fitted=world)
    assert captured_person(folder, FIRST).subject == FIRST
    write_npz(path, world=world, fitted=world + np.float32([0, 0.1, 0]))
    with refused(ValueError, "joints"):
        captured_person(folder, FIRST)


def test_fewer_betas_are_filled_up(tmp_path):
    person = ring(tmp_path, 3)
    person = dataclasses.replace(person, smpl=dataclasses.replace(person.smpl, betas=np.ones(4, np.float32)))
    assert default_betas(person).tolist() == [1.0] * 4 + [0.0] * 6
    assert len(default_betas(person)) == default_body().shape_basis.shape[-1]


def test_masks_beside_the_body_are_a_warning_and_masks_around_it_are_none(dataset, tmp_path):
    (warning,) = captured_person(dataset, FIRST).warnings
    assert "of the body of person_000000 is inside the masks" in warning
    job = small_job(tmp_path, people=1, frames=1, passes=("img", "mask"))
    for path in job.people.values():
        save_person(path, TexturedMesh((box(half=1.0),)))
    list(render(job))
    assert captured_person(job.out).warnings == ()


def test_one_view_works_and_warns(dataset):
    person = captured_person(dataset, FIRST, views=1)
    assert len(person.cameras) == 1
    assert person.warnings[0] == "only one view: the sides that it does not show are guessed"


def masks(subject: Path, size: tuple[int, int], value: int) -> None:
    for camera in range(4):
        Image.new("L", size, value).save(picture_path(subject, "mask", camera, 0))


def look_past(subject: Path) -> None:
    path = subject / "cameras.json"
    cameras = {name: {**about, "T": [5.0, 0.0, 0.0]} for name, about in json.loads(path.read_text()).items()}
    path.write_text(json.dumps(cameras))


@pytest.mark.parametrize(
    ("damage", "error", "fact"),
    [
        (lambda folder: masks(folder / FIRST, (16, 32), 255), FileError, "mask"),
        (lambda folder: masks(folder / FIRST, (32, 32), 0), ValueError, "mask"),
        (lambda folder: look_past(folder / FIRST), ValueError, "mask"),
        (lambda folder: rewrite_betas(folder, np.zeros(300)), ValueError, "300 betas"),
        (lambda folder: rewrite_betas(folder, [4.0, -4.0, 4.0, 0, 0, 0, 0, 0, 0, 0]), ValueError, "joints"),
    ],
)
def test_captures_that_show_no_body_are_rejected(folder, damage, error, fact):
    damage(folder)
    with refused(error, fact):
        captured_person(folder, FIRST)
