"""Samples of captures: what is in them, their order, going on, packs."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from capture_scenes import captured
from primdiffusion.capture.dataset import CaptureDataset, Position, SampleSettings, batches
from primdiffusion.capture.reader import Window, full_window, open_captures, resample, windowed_view
from primdiffusion.formats.camera_rig import View
from primdiffusion.geometry.records import TensorRecord
from support.errors import refused

SETTINGS = SampleSettings(2, 1, 16, "whole", "first")


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return open_captures(captured(tmp_path_factory.mktemp("captures"), people=3, passes=("img", "mask")))


def same(first: TensorRecord, second: TensorRecord) -> bool:
    """Whether all tensors of two records are equal."""
    pairs = ((getattr(first, f.name), getattr(second, f.name)) for f in dataclasses.fields(first))
    return all(
        same(a, b) if isinstance(a, TensorRecord) else torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
        for a, b in pairs
    )


def first(count: int, dataset: CaptureDataset, size: int = 2, **more) -> list:
    return list(itertools.islice(batches(dataset, size, **more), count))


def test_a_batch_holds_views_cameras_poses_and_shapes(captures):
    ((batch, after),) = first(1, CaptureDataset(captures, SETTINGS))
    assert batch.conditioning.image.shape == (2, 2, 16, 16, 3)
    assert batch.target.mask.shape == (2, 1, 16, 16)
    assert batch.target.camera.intrinsics.shape == (2, 1, 3, 3)
    assert (batch.target.camera.width, batch.target.camera.height) == (16, 16)
    assert batch.target.pose.joint_rotation.shape == (2, 24, 3, 3)
    assert batch.betas.shape == (2, 10)
    assert after == Position(0, 2)


def test_a_sample_is_what_the_reader_reads(captures):
    sample = CaptureDataset(captures, SampleSettings(1, 3, 32, "whole", "same"))[0, 4]
    name, frame = captures.subjects[int(sample.subject)], int(sample.frame)
    subject = captures.subject(name)
    views = [torch.from_numpy(subject.picture("img", frame, camera)) for camera in range(4)]
    shown = torch.cat([sample.conditioning.image, sample.target.image])
    numbers = [next(i for i, view in enumerate(views) if torch.equal(view, image)) for image in shown]
    assert sorted(numbers) == [0, 1, 2, 3]
    for number, camera in zip(numbers[1:], sample.target.camera.world_to_camera, strict=True):
        assert torch.equal(subject.camera(number).world_to_camera, camera)
    assert torch.equal(sample.target.pose.joint_rotation, subject.smpl.pose(frame).joint_rotation)


def test_conditioning_views_of_the_first_frame_show_the_near_t_pose(captures):
    near_t = captures.subject(captures.subjects[0]).smpl.pose(0)
    samples = [CaptureDataset(captures, SETTINGS)[0, index] for index in range(9)]
    assert all(torch.equal(sample.conditioning.pose.joint_rotation, near_t.joint_rotation) for sample in samples)


def test_an_epoch_has_every_pose_of_every_human_once_in_its_own_order(captures):
    dataset = CaptureDataset(captures, SETTINGS)
    epochs = [[(int(s.subject), int(s.frame)) for s in (dataset[e, i] for i in range(len(dataset)))] for e in (0, 1)]
    assert sorted(epochs[0]) == sorted(epochs[1]) == list(itertools.product(range(3), range(3)))
    assert epochs[0] != epochs[1]


@pytest.mark.parametrize("workers", [1, 3])
def test_any_number_of_workers_gives_the_same_batches(captures, workers):
    dataset = CaptureDataset(captures, dataclasses.replace(SETTINGS, framing="crop"), seed=5)
    for (one, at), (other, there) in zip(first(7, dataset), first(7, dataset, workers=workers), strict=True):
        assert at == there
        assert same(one, other)


def test_another_seed_gives_another_order(captures):
    (one, _), (other, _) = (first(1, CaptureDataset(captures, SETTINGS, seed), 9)[0] for seed in (0, 1))
    assert not torch.equal(one.frame * 3 + one.subject, other.frame * 3 + other.subject)


def test_training_goes_on_where_it_stopped_across_epochs(captures):
    dataset = CaptureDataset(captures, SETTINGS)
    through = first(8, dataset)
    _, stopped = through[3]
    assert stopped == Position(0, 8)
    again = first(4, CaptureDataset(captures, SETTINGS), start=stopped, workers=1)
    assert all(same(one, other) and at == there for (one, at), (other, there) in zip(through[4:], again, strict=True))
    assert through[4][1] == Position(1, 1)


def test_a_smaller_picture_is_the_mean_of_linear_light_and_its_camera_sees_the_same():
    rgba = np.zeros((4, 4, 4), np.uint8)
    rgba[:, 2:] = 255
    small = resample(rgba, Window(0, 0, 4, 4), 2)
    assert small[0].tolist() == [[0, 0, 0, 0], [255, 255, 255, 255]]
    middle = resample(rgba, Window(1, 0, 2, 4), 1)
    assert middle[0, 0].tolist() == [188, 188, 188, 128]  # half of the light
    assert resample(rgba, Window(-2, 0, 4, 4), 1)[0, 0].tolist() == [0, 0, 0, 0]
    view = View(np.array([[5.0, 0.1, 2], [0, 5, 2], [0, 0, 1]]), np.eye(3), np.array([0, 0, 3.0]), 4, 4)
    point = np.array([0.3, -0.2, 0.4])
    window = Window(0.5, 1.25, 2, 2.5)
    pixel, seen = view.project(point)[0], windowed_view(view, window, 16).project(point)[0]
    np.testing.assert_allclose(seen, (pixel - (0.5, 1.25)) * (16 / 2, 16 / 2.5))
    assert np.array_equal(windowed_view(view, full_window(view), 4).intrinsics, view.intrinsics)


def test_crops_lie_in_the_picture_and_see_the_person(captures):
    dataset = CaptureDataset(captures, dataclasses.replace(SETTINGS, framing="crop"))
    samples = [dataset[epoch, index] for epoch in range(3) for index in range(9)]
    focal = captures.subject(captures.subjects[0]).views[0].intrinsics[0, 0]
    scales = [float(s.target.camera.intrinsics[0, 0, 0]) / focal for s in samples]
    assert 0.5 <= min(scales) < 0.6
    assert 0.9 < max(scales) <= 1
    assert np.mean([bool(s.target.mask.any()) for s in samples]) > 0.9


@pytest.mark.parametrize("wrong", [{"views": 0}, {"targets": -1}, {"size": 0}])
def test_samples_without_views_are_rejected(wrong):
    with refused(ValueError, next(iter(wrong))):
        SampleSettings(**wrong)
