"""Voxels as direct targets: fitted once to all images of a subject, brought into a sample's boxes, learned from."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_scenes import make_small, settings
from primdiffusion.capture.conditioning import conditioning_views, default_betas
from primdiffusion.capture.reader import open_captures
from primdiffusion.encoder.config import PRESETS
from primdiffusion.encoder.model import EncoderModel, frames_of, load_encoder
from primdiffusion.encoder.network import Encoder
from primdiffusion.primitives.primitives import K, Payload, Primitives, S
from primdiffusion.reconstruction.from_captures import targets_of
from primdiffusion.render.march import march
from primdiffusion.training import fit_voxels
from primdiffusion.training.fit import MODEL, fit
from primdiffusion.training.fit_config import LossConfig
from primdiffusion.training.fit_voxels import FittedVoxels, fit_missing, read_fitted, resampled, voxel_loss
from support.errors import refused
from support.runs import rows

pytestmark = pytest.mark.usefixtures("small_fit")

NAMES = ("person_000000", "person_000001")
VOXELS_ALONE = LossConfig(rgb=0.0, silhouette=0.0, voxels=1.0)


@pytest.fixture(scope="module")
def fitted(captures, tmp_path_factory) -> Path:
    """Voxels of both people, in a module of their own: fitting takes seconds."""
    folder = tmp_path_factory.mktemp("fitted")
    with pytest.MonkeyPatch.context() as patch:
        make_small(patch)
        patch.setattr(fit_voxels, "SIDE", 48)
        fit_missing(open_captures(captures), PRESETS["default"], folder)
    return folder


def drawn_voxels(extent: float = 1.0) -> FittedVoxels:
    draws = torch.Generator().manual_seed(1)
    return FittedVoxels(
        torch.rand(K, 3, S, S, S, generator=draws),
        torch.rand(K, S, S, S, generator=draws),
        torch.rand(K, 2, S, S, S, generator=draws),
        torch.tensor([0.85, 0.85, extent]).repeat(K, 1),
    )


def image_error(payload: Payload, path: Path, name: str) -> float:
    """Mean square error over all images of a subject, linear colours over black and alpha, 48 x 48."""
    captures, config, squares = open_captures(path), PRESETS["default"], []
    betas = default_betas(captures.subject(name))
    for frame in range(2):
        views = conditioning_views(captures, name, frame)
        frames = frames_of(config, betas, views.pose)[1]
        for target in targets_of(views, [frames] * len(views.rgba), 48):
            image = march(Primitives.place(frames, payload), target.camera)
            squares.append(torch.cat([image.rgb, image.alpha[..., None]], -1).numpy() - target.rgba.numpy())
    return float(np.square(squares).mean())


@pytest.mark.parametrize("name", NAMES)
def test_fitted_voxels_draw_the_images_better_than_the_hull_they_start_from(captures, fitted, name):
    config, voxels = PRESETS["default"], read_fitted(fitted, name)
    opened = open_captures(captures)
    hull = EncoderModel(Encoder(config).eval(), {}).encode(
        conditioning_views(opened, name), default_betas(opened.subject(name))
    )
    payload = Payload(voxels.rgb, voxels.density * config.full_density, voxels.extent)
    assert image_error(payload, captures, name) < 0.85 * image_error(hull, captures, name)  # cubes reach out of boxes
    assert torch.isfinite(voxels.weight).all()
    assert (voxels.weight.flatten(2).sum((1, 2)) > 0).any()


def test_only_what_is_missing_is_fitted(captures, fitted, tmp_path, monkeypatch):
    (tmp_path / f"{NAMES[0]}.npz").write_bytes((fitted / f"{NAMES[0]}.npz").read_bytes())
    made = []

    def note(captures, name, encoder):
        made.append(name)
        return drawn_voxels()

    monkeypatch.setattr(fit_voxels, "fit_subject", note)
    for _ in range(2):
        fit_missing(open_captures(captures), PRESETS["default"], tmp_path)
    assert made == [NAMES[1]]
    other = dataclasses.replace(PRESETS["default"], extent=(1.0, 1.0, 1.0))
    fit_missing(open_captures(captures), other, tmp_path)  # other boxes, though of the same names
    assert made == [NAMES[1], *NAMES]
    kept = read_fitted(tmp_path, NAMES[1])
    for name in ("rgb", "density", "weight", "extent"):
        assert torch.allclose(getattr(kept, name), getattr(drawn_voxels(), name), atol=1e-5), name


def test_thinner_boxes_hold_the_same_field():
    thick = drawn_voxels()
    field = torch.linspace(0, 1, S)[:, None, None].expand(S, S, S)  # linear along N
    thick = dataclasses.replace(thick, density=field.expand(K, S, S, S))
    thin = resampled(thick, torch.tensor([0.85, 0.85, 0.5]).repeat(K, 1))
    place = torch.linspace(-0.5, 0.5, S)[:, None, None]
    assert torch.allclose(thin.density, ((place + 1) / 2).expand(K, S, S, S), atol=1e-6)
    same = resampled(thick, thick.extent)
    assert torch.allclose(same.rgb, thick.rgb, atol=1e-6)
    assert torch.allclose(same.weight, thick.weight, atol=1e-6)


def test_boxes_thicker_than_the_fitted_ones_are_empty_beyond_them():
    thick = resampled(drawn_voxels(0.5), drawn_voxels(1.0).extent)
    assert (thick.density[:, [0, 1, -2, -1]] == 0).all()
    assert (thick.density[:, [3, 4]] > 0).any()


def test_the_loss_is_the_weighted_square_distance():
    voxels = drawn_voxels()
    exact = Payload(voxels.rgb, 100 * voxels.density, voxels.extent)
    assert voxel_loss(exact, voxels, 100.0) < 1e-6
    changed = dataclasses.replace(exact, rgb=voxels.rgb.clone(), density=exact.density.clone())
    changed.rgb[5, 1, 2, 3, 4] += 0.5
    changed.density[7, 1, 2, 3] += 20.0
    expected = voxels.weight[5, 0, 2, 3, 4] * 0.5**2 + voxels.weight[7, 1, 1, 2, 3] * 0.2**2
    assert torch.isclose(voxel_loss(changed, voxels, 100.0), (255 / 16) ** 2 * expected, rtol=1e-4)
    batch = voxels.map(lambda tensor: tensor[None].repeat_interleave(2, 0))
    both = changed.map(lambda tensor: tensor[None].repeat_interleave(2, 0))
    assert torch.isclose(voxel_loss(both, batch, 100.0), voxel_loss(changed, voxels, 100.0))


def test_a_run_learns_from_voxels_without_marching_and_keeps_the_boxes(captures, fitted, tmp_path, monkeypatch):
    def refuse(*_):
        raise AssertionError("marched")

    monkeypatch.setattr("primdiffusion.training.fit.march", refuse)
    monkeypatch.setattr("primdiffusion.training.fit.measure", lambda *_: 0.0)
    monkeypatch.setattr("primdiffusion.training.fit.write_pictures", lambda *_: None)
    run = tmp_path / "run"
    rates = {"learning_rate": 2e-2, "place_rate": 1.0, "ema": 0.5}
    config = settings(captures, run, steps=60, conditioning_frame="first", loss=VOXELS_ALONE, fitted=fitted, **rates)
    model = fit(config)
    loss = [row["voxels"] for row in rows(run) if "voxels" in row]
    assert np.mean(loss[-10:]) < 0.9 * np.mean(loss[:10])
    assert not {"rgb", "silhouette"} & rows(run)[0].keys()
    assert model.card["loss"]["voxels"] == 1.0
    opened = open_captures(captures)
    payload = load_encoder(run / MODEL).encode(conditioning_views(opened, NAMES[0]), torch.zeros(10))
    assert torch.allclose(payload.delta_scale, torch.tensor(PRESETS["default"].extent), rtol=1e-2)


def test_both_losses_together(captures, fitted, tmp_path):
    fit(settings(captures, tmp_path / "run", steps=1, loss=LossConfig(voxels=1.0), fitted=fitted))
    assert {"rgb", "silhouette", "voxels"} <= rows(tmp_path / "run")[0].keys()


def test_a_loss_of_voxels_without_a_folder_is_rejected(captures, tmp_path):
    with refused(ValueError, "--fitted"):
        settings(captures, tmp_path / "run", loss=VOXELS_ALONE)


def test_damaged_voxels_are_named(captures, fitted, tmp_path):
    for name in NAMES:
        (tmp_path / f"{name}.npz").write_bytes((fitted / f"{name}.npz").read_bytes()[:-500])
    with refused(ValueError, f"{tmp_path}"):
        fit(settings(captures, tmp_path / "run", loss=VOXELS_ALONE, fitted=tmp_path))
    with np.load(fitted / f"{NAMES[0]}.npz") as arrays:
        for name, wrong in (("rgb", np.zeros((K, 3, S, S), np.uint16)), ("weight", np.full((K, 2, S, S, S), np.nan))):
            np.savez(tmp_path / f"{NAMES[0]}.npz", **{**arrays, name: wrong})
            with refused(ValueError, f"{NAMES[0]}.npz", name):
                read_fitted(tmp_path, NAMES[0])
