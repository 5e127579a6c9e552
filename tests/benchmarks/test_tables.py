"""The comparison of Table 2: the latent baseline, training by processor time, and the table's figures."""

import argparse
import dataclasses
import importlib.util

import everywhere
import numpy as np
import pytest
import tables
import torch
from diffuse_runs import settings
from diffusion_people import small_model, write_people
from latent_baseline import decoded_rest, sample_people
from primdiffusion.capture.coco import KEYPOINTS
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.evaluation.tables import Cell, Networks, Scores
from primdiffusion.formats.camera_rig import View
from primdiffusion.formats.joints import JOINT_NAMES
from support.errors import refused
from tables import Model, check_equal, figures_of, judged
from train_baselines import train_model

CARD = {"minutes": 3.0, "people": 10, "geometries": 5, "steps": {"local": 7}}


@pytest.fixture(scope="module")
def baseline():
    model = small_model()
    return dataclasses.replace(model, card={**model.card, "baseline": "latents"})


def test_everything_of_a_human_follows_from_its_vector(baseline):
    (human,) = sample_people(baseline, [5], steps=3)
    prior = baseline.denoiser.prior
    x0 = baseline.encode(human.payload)[None]
    coefficients, _ = prior.split(x0)
    again = prior.join(coefficients, prior.rest_variance.sqrt() * decoded_rest(baseline.denoiser, coefficients))
    decoded = baseline.decode(again.detach())
    inside = (human.payload.density > 0) & (human.payload.density < baseline.full_density)
    assert human.payload.density.std() > 0
    assert float((decoded.density[0] - human.payload.density)[inside].abs().mean()) < 40


def test_latent_samples_follow_from_their_seeds(baseline):
    first, second = sample_people(baseline, [1, 2], steps=2)
    (again,) = sample_people(baseline, [2], steps=2)
    assert torch.allclose(again.payload.rgb, second.payload.rgb, atol=1e-4)
    assert torch.allclose(again.betas, second.betas, atol=1e-4)
    assert not torch.allclose(first.payload.rgb, second.payload.rgb, atol=1e-2)


def test_another_model_is_no_latent_baseline():
    with refused(ValueError, "baseline"):
        sample_people(small_model(), [0])


@pytest.mark.parametrize("kind", ["ours", "latents"])
def test_models_are_trained_for_their_time_and_go_on(tmp_path, kind):
    write_people(tmp_path / "people", 10)
    config = settings(tmp_path / "people", tmp_path / "prepared")
    config.run.mkdir()
    out = tmp_path / "out"
    out.mkdir()
    train_model(config, kind, out, minutes=0.01, threads=1)
    model = load_checkpoint(out / "model.safetensors")
    assert model.card["baseline"] == kind
    assert model.card["people"] == 16
    assert set(model.card["steps"]) == {"person", "local"}
    written = (out / "local.state.safetensors").stat().st_mtime
    train_model(config, kind, out, minutes=0.01, threads=1)
    again = load_checkpoint(out / "model.safetensors")
    assert again.card["steps"] == model.card["steps"]
    assert written <= (out / "local.state.safetensors").stat().st_mtime


def test_unequal_models_are_not_compared():
    check_equal({"ours": CARD, "latents": {**CARD, "minutes": 3.1}})
    with refused(ValueError, "trained"):
        check_equal({"ours": CARD, "latents": {**CARD, "minutes": 4.0}})
    with refused(ValueError, "trained"):
        check_equal({"ours": CARD, "latents": {**CARD, "people": 11}})


def test_figures_name_model_and_measure():
    def images(seeds, views):
        return iter(())

    rows = {"ours": {"own_distance": Cell(1.2345)}, "floor": {"own_pckh": Cell(30.0), "own_depth": Cell(90.0)}}
    figures = figures_of(rows, dict.fromkeys(("ours", "latents", "voxels"), Model(CARD, images)))
    assert figures["distance_ours"] == 1.234
    assert figures["pckh_floor"] == 30.0
    assert figures["depth_error_latents"] is None
    assert figures["steps_local_voxels"] == 7
    assert "distance_floor" not in figures


def test_what_was_seen_is_not_looked_at_again(tmp_path, monkeypatch):
    asked = []

    def evaluate(images, networks):
        seeds = list(images)
        asked.extend(seeds)
        features = {"own": torch.tensor(seeds)[:, None].float(), "detail": torch.zeros(len(seeds), 3)}
        return Scores(len(seeds), features, [0.5] * len(seeds), [])

    monkeypatch.setattr(tables, "look_at_pictures", evaluate)
    first = judged("ours", iter, list(range(10)), Networks(None), tmp_path)
    again = judged("ours", iter, list(range(10)), Networks(None), tmp_path)
    assert asked == list(range(10))
    assert torch.equal(first.features["own"], again.features["own"])
    assert again.features["own"][:, 0].tolist() == asked
    assert len(again.correct) == again.pictures == 10


def front() -> View:
    """A view of the T pose, 64 pixels wide."""
    intrinsics = np.array([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]])
    return View(intrinsics, np.diag([1.0, -1, -1]), np.array([0.0, -0.3, 3]), 64, 64)


def body() -> tuple[np.ndarray, np.ndarray]:
    return everywhere.posed({"betas": [0.0] * 10, "pose": [0.0] * 72, "translation": [0.0] * 3})


@pytest.mark.skipif(importlib.util.find_spec("pycocotools") is None, reason="there is nothing to read COCO with")
@pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="there is nothing to cast rays with")
def test_annotations_of_bodies_that_stand_together_agree_with_rays(tmp_path):
    found = everywhere.coco(argparse.Namespace(size=128, frames=1, cameras=3), tmp_path)
    assert found["coco_annotations"] >= 6
    assert min(found["coco_mask_iou_min"], found["amodal_iou_min"]) > 0.9
    assert found["coco_keypoint_error_px"] < 0.02
    assert found["capture_overhead_ratio_fast"] > 1


@pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="there is nothing to cast rays with")
def test_rays_hit_the_body_where_its_joints_are_seen():
    vertices, joints = body()
    view = front()
    distance = everywhere.cast(vertices, view)
    pixels, _ = view.project(joints)
    seen = [JOINT_NAMES.index(name) for name in ("left_hip", "neck", "right_knee")]
    columns, rows = np.floor(pixels[seen]).astype(int).T
    assert np.isfinite(distance[rows, columns]).all()
    assert np.isinf(distance[0]).all()
    assert 0.05 < np.isfinite(distance).mean() < 0.5


def test_a_keypoint_that_is_off_by_two_pixels_is_noticed_unless_it_is_unknown():
    _, joints = body()
    view = front()
    pixels, _ = view.project(joints)
    keypoints = np.zeros((len(KEYPOINTS), 3))
    for place, name in enumerate(KEYPOINTS):
        if name in JOINT_NAMES:
            keypoints[place] = (*pixels[JOINT_NAMES.index(name)] - 0.5, 2)
    assert everywhere.keypoint_error(keypoints.ravel().tolist(), view, joints) < 1e-9
    keypoints[KEYPOINTS.index("left_knee"), 0] += 2
    assert everywhere.keypoint_error(keypoints.ravel().tolist(), view, joints) == pytest.approx(2)
    keypoints[KEYPOINTS.index("left_knee"), 2] = 0
    assert everywhere.keypoint_error(keypoints.ravel().tolist(), view, joints) < 1e-9


def test_overlap_is_the_intersection_over_the_union():
    one, other = np.array([True, True, False, False]), np.array([True, False, True, False])
    assert everywhere.overlap(one, other) == pytest.approx(1 / 3)
    assert everywhere.overlap(one, one) == 1
