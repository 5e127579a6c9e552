"""Evaluation of reconstructions, by a model that needs no training: grey boxes on the body."""

import json

import pytest
import torch
from capture_scenes import captured
from primdiffusion import cli
from primdiffusion.body.model import default_body
from primdiffusion.capture.conditioning import spread_cameras
from primdiffusion.capture.reader import open_captures
from primdiffusion.evaluation.reconstruction import (
    SPLITS,
    EvaluationSettings,
    ImageMetrics,
    PictureScore,
    evaluate,
    image_metrics,
    summary,
    table,
)
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import pose_body
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.primitives import K, Payload, Primitives
from primdiffusion.render.march import MarchSettings, march
from support.errors import refused
from support.tiny import save_tiny_encoder

COARSE = MarchSettings(step=0.016)


class Grey:
    """Everybody is grey; notes what it is given."""

    def __init__(self, level=0.2):
        self.card = {"name": "grey", "steps": 0}
        self.body = default_body()
        self.level = level
        self.given = []
        self.placed = []

    def encode(self, views, betas):
        self.given.append((views, betas))
        return Payload(
            rgb=torch.full((K, 3, 8, 8, 8), self.level),
            density=torch.full((K, 8, 8, 8), 50.0),
            delta_scale=torch.ones(K, 3),
        )

    def place(self, payload, betas, pose):
        self.placed.append(pose)
        vertices = pose_body(betas, pose).vertices
        return Primitives.place(attach(default_anchors(), vertices, default_body().faces), payload)


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return open_captures(captured(tmp_path_factory.mktemp("captures"), passes=("img", "mask")))


@pytest.fixture(scope="module")
def scored(captures):
    model = Grey()
    settings = EvaluationSettings(given_views=2, given_frame=1, size=32, march=COARSE)
    return model, list(evaluate(model, captures, settings))


def test_every_picture_is_scored_once_and_every_human_encoded_once(scored, captures):
    model, scores = scored
    places = [(score.subject, score.frame, score.camera) for score in scores]
    assert places == [(name, frame, camera) for name in captures.subjects for frame in range(3) for camera in range(4)]
    assert len(model.given) == len(captures.subjects)
    assert len(model.placed) == 3 * len(captures.subjects)


def test_encoder_is_given_spread_views_of_one_pose(scored, captures):
    model, scores = scored
    for (views, betas), name in zip(model.given, captures.subjects, strict=True):
        subject = captures.subject(name)
        cameras = spread_cameras(subject, 1, 2)
        assert views.rgba.shape == (2, 32, 32, 4)
        for view, camera in enumerate(cameras):
            assert torch.equal(views.rgba[view], torch.from_numpy(subject.rgba(1, camera)))
            assert torch.allclose(views.camera.world_to_camera[view], subject.camera(camera).world_to_camera)
        assert torch.equal(views.pose.joint_rotation, subject.smpl.pose(1).joint_rotation)
        assert betas.shape == (10,)
        assert {score.camera for score in scores if score.subject == name and score.given_view} == set(cameras)
    assert {score.frame for score in scores if score.given_pose} == {1}


@pytest.mark.parametrize("level", [0.2, 7.0])
def test_scores_are_those_of_the_drawn_pictures(level, captures):
    """Colours beyond white are white."""
    name, model = captures.subjects[0], Grey(level)
    subject = captures.subject(name)
    (score,) = evaluate(model, captures, EvaluationSettings((name,), (1,), (2,), 1, 0, 32, COARSE))
    seen = torch.from_numpy(subject.rgba(1, 2))
    primitives = model.place(model.encode(None, None), torch.from_numpy(subject.smpl.betas), subject.smpl.pose(1))
    image = encode_srgb(march(primitives, subject.camera(2), COARSE).rgb.clamp(0, 1))
    error = (image - seen[..., :3] / 255).square().mean()
    assert score.likeness.psnr == pytest.approx(float(-10 * error.log10()), abs=1e-3)


def test_evaluation_is_deterministic(scored, captures):
    again = list(evaluate(Grey(), captures, EvaluationSettings(given_views=2, given_frame=1, size=32, march=COARSE)))
    assert again == scored[1]


def test_another_model_scores_otherwise(scored, captures):
    settings = EvaluationSettings((captures.subjects[0],), (0,), (1,), 1, 0, 32, COARSE)
    (dark,), (bright,) = (list(evaluate(Grey(level), captures, settings)) for level in (0.0, 1.0))
    assert dark.likeness.psnr != bright.likeness.psnr
    assert dark.likeness.mask_iou == bright.likeness.mask_iou > 0


def test_chosen_subjects_frames_and_cameras_are_kept_to(captures):
    name = captures.subjects[1]
    scores = list(evaluate(Grey(), captures, EvaluationSettings((name,), (2,), (3, 0), 4, 0, 16, COARSE)))
    assert [(score.subject, score.frame, score.camera) for score in scores] == [(name, 2, 3), (name, 2, 0)]
    assert all(score.given_view and not score.given_pose for score in scores)


def test_frames_that_are_not_there_are_rejected(captures):
    with refused(ValueError, "0 to 2"):
        list(evaluate(Grey(), captures, EvaluationSettings(given_frame=7, size=32)))
    with refused(KeyError, "nobody"):
        list(evaluate(Grey(), captures, EvaluationSettings(("nobody",), size=32)))


def test_a_picture_is_most_like_itself():
    rgba = torch.randint(0, 256, (24, 20, 4), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    metrics = image_metrics(rgba / 255, rgba / 255)
    assert metrics.psnr > 90
    assert metrics.ssim == pytest.approx(1, abs=1e-5)
    assert metrics.mask_iou == 1


def test_the_box_leaves_out_what_is_black_around_the_person():
    rgba = torch.zeros(40, 40, 4, dtype=torch.uint8)
    rgba[10:30, 5:25] = 255
    other = rgba.clone()
    other[10:20, 5:25, 0] = 128
    metrics = image_metrics(other / 255, rgba / 255)
    quarter = 20 * 20 / 40**2
    assert metrics.psnr_box == pytest.approx(metrics.psnr + 10 * torch.tensor(quarter).log10().item(), abs=1e-3)
    assert metrics.ssim_box < metrics.ssim


def test_an_empty_picture_has_no_box():
    rgba = torch.zeros(16, 16, 4, dtype=torch.uint8)
    metrics = image_metrics(rgba / 255, rgba / 255)
    assert (metrics.psnr_box, metrics.ssim_box, metrics.mask_iou) == (None, None, 1)


def score(psnr, given_view, given_pose, box=None):
    return PictureScore("a", 0, 0, given_view, given_pose, ImageMetrics(psnr, 0.5, box, box, 1.0))


def test_summary_averages_each_part_alone():
    scores = [score(30, True, True, 20), score(20, False, True), score(16, False, False, 10), score(18, False, False)]
    means = summary(scores)
    assert list(means) == list(SPLITS)
    assert [(part["pictures"], part["psnr"], part["psnr_box"]) for part in means.values()] == [
        (4, 21, 15), (1, 30, 20), (1, 20, None), (0, None, None), (2, 17, 10)
    ]  # fmt: skip
    rows = table(means).splitlines()
    assert rows[2] == "| all views, all poses | 4 | 21.00 | 0.5000 | 15.00 | 15.0000 | 1.0000 | - |"
    assert rows[5] == "| given views, novel poses | 0 | - | - | - | - | - | - |"


def test_the_command_line_evaluates_a_checkpoint(captures, tmp_path, capsys):
    path, scores = save_tiny_encoder(tmp_path / "tiny.safetensors"), tmp_path / "new" / "scores.json"
    line = ["--captures", str(captures.root), "--people", "1", "--views", "3", "--size", "16"]
    cli.run(["evaluate", "reconstruction", *line, "--checkpoint", str(path), "--json", str(scores)])
    record = json.loads(scores.read_text())
    assert record["checkpoint"] == {"name": "tiny encoder"}
    assert record["settings"]["subjects"] == [captures.subjects[0]]
    assert len(record["pictures"]) == 12
    assert [part["pictures"] for part in record["means"].values()] == [12, 3, 1, 6, 2]
    assert "| novel views, novel poses | 2 | " in capsys.readouterr().out


def test_command_tells_wrong_folders_and_numbers(captures, tmp_path, fails):
    line = ("evaluate", "reconstruction", "--captures", captures.root)
    for words, named in (
        (["--captures", tmp_path / "none"], "the folder of captures"),
        (["--people", "-1"], "people is -1"),
        (["--checkpoint", tmp_path / "no.safetensors"], "no.safetensors"),
        (["--lpips", tmp_path / "w.pth"], "w.pth"),
    ):
        failed = fails(*line, *words)
        assert failed.code == 1
        assert named in failed.err
