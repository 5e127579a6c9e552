import dataclasses
import math
import os
import signal
import threading

import numpy as np
import pytest
import torch
from diffuse_runs import settings
from diffusion_people import write_people
from primdiffusion.diffusion.codec import mirror_cells
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.schedule import fine_linear, linear, sqrt_linear
from primdiffusion.primitives.primitives import GRID
from primdiffusion.training.cells import CellTrainee, prepare
from primdiffusion.training.config import PhaseConfig, PriorConfig, check_resumable, to_json
from primdiffusion.training.latents import LatentSet, split_people
from primdiffusion.training.losses import (
    blend_conditions,
    blends,
    closed_form,
    level_weight,
    mixed,
    objective,
    random_steps,
    weighted_error,
    x0_errors,
)
from primdiffusion.training.prior import fit_prior
from primdiffusion.training.recorder import Interrupt
from primdiffusion.training.shards import open_people
from primdiffusion.training.state import TrainingState, learning_rate_factor
from primdiffusion.training.stored_people import find_people, read_person


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    folder = tmp_path_factory.mktemp("people")
    write_people(folder, geometries=16, variants=3)
    return folder


@pytest.fixture(scope="module")
def prepared_once(people, tmp_path_factory):
    config, found = settings(people, tmp_path_factory.mktemp("prepared")), open_people(people)
    return config, prepare(config, found, *split_people(range(16), config.holdout, config.seed))


def state_of_a_line(seed=0):
    torch.manual_seed(3)
    network = torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.Dropout(0.5), torch.nn.Linear(8, 1))
    return TrainingState(network, PhaseConfig(steps=50, batch=4), seed)


def advance(state, steps):
    for _ in range(steps):
        state.network.train()
        x = torch.randn(4, 3, generator=state.generator)
        state.update((state.network(x) - x.sum(1, keepdim=True)).square().mean())


def test_a_state_saved_in_the_middle_goes_on_bit_for_bit(tmp_path):
    whole, part = state_of_a_line(), state_of_a_line()
    torch.manual_seed(11)
    advance(whole, 20)
    torch.manual_seed(11)
    advance(part, 7)
    part.save(tmp_path / "state")
    torch.randn(100)  # anything else drawn in between must not matter
    resumed = state_of_a_line(seed=99)
    resumed.load(tmp_path / "state")
    advance(resumed, 13)
    assert resumed.step == 20
    for a, b in zip(whole.network.parameters(), resumed.network.parameters(), strict=True):
        assert torch.equal(a, b)
    for a, b in zip(whole.average.parameters(), resumed.average.parameters(), strict=True):
        assert torch.equal(a, b)


def test_the_average_lags_behind_the_weights():
    state = state_of_a_line()
    start = [p.clone() for p in state.network.parameters()]
    advance(state, 15)
    moved = sum((p - q).abs().sum() for p, q in zip(state.network.parameters(), start, strict=True))
    lagged = sum((p - q).abs().sum() for p, q in zip(state.average.parameters(), start, strict=True))
    assert 0 < lagged < moved


def test_a_damaged_or_foreign_state_is_refused(tmp_path):
    state, other = state_of_a_line(), TrainingState(torch.nn.Linear(2, 2), PhaseConfig(steps=1, batch=1), 0)
    state.save(tmp_path / "state")
    with pytest.raises(ValueError, match="does not fit"):
        other.load(tmp_path / "state")
    (tmp_path / "state").write_bytes((tmp_path / "state").read_bytes()[:100])
    with pytest.raises(ValueError, match="damaged"):
        state_of_a_line().load(tmp_path / "state")


def test_a_gradient_that_is_not_finite_stops_the_run():
    state = state_of_a_line()
    with pytest.raises(FloatingPointError, match="step 0"):
        state.update(state.network(torch.full((1, 3), float("nan"))).sum())


def test_learning_rate_warms_up_and_falls_to_a_tenth():
    assert learning_rate_factor(0, 1000) == pytest.approx(0.01)
    assert learning_rate_factor(99, 10**9) == pytest.approx(1.0)
    assert learning_rate_factor(1000, 1000) == pytest.approx(0.1)


def test_ctrl_c_stops_after_the_step_and_the_handler_is_given_back():
    before = signal.getsignal(signal.SIGINT)
    with Interrupt(None) as interrupt:
        assert not interrupt.due()
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        for _ in range(200):
            if interrupt.due():
                break
            threading.Event().wait(0.02)
        assert interrupt.due()
    assert signal.getsignal(signal.SIGINT) is before


def test_other_settings_are_refused_and_other_limits_are_not(people, tmp_path):
    saved = to_json(settings(people, tmp_path))
    check_resumable(saved, settings(people, tmp_path / "moved", minutes=3.0))
    with pytest.raises(ValueError, match=r"prior\.components"):
        check_resumable(saved, settings(people, tmp_path, prior=PriorConfig(components=7)))


def test_held_out_geometries_are_never_trained_on(people):
    paths = find_people(people)
    train_paths, held = split_people(paths, 0.2, seed=0)
    assert len(held) == 3
    assert set(train_paths).isdisjoint(held)
    assert sorted(train_paths + held) == paths
    assert split_people(paths, 0.2, seed=0) == (train_paths, held)
    assert split_people(paths, 0.2, seed=1)[1] != held


def test_the_prior_s_components_are_even_or_odd_in_the_mirror(prepared_once):
    _, prepared = prepared_once
    prior, codec = prepared.prior, prepared.codec
    pictures = prior.basis.unflatten(1, prior.mean.shape)
    assert torch.allclose(codec.mirror(pictures), pictures * prior.parity[:, None, None, None], atol=1e-3)
    assert torch.allclose(prior.basis @ prior.basis.T, torch.eye(6), atol=1e-4)
    assert torch.allclose(codec.mirror(prior.mean), prior.mean, atol=1e-3)
    assert torch.allclose(mirror_cells(codec.mean), codec.mean, atol=1e-3)


def test_the_prior_describes_the_people_it_was_fitted_to(prepared_once):
    _, prepared = prepared_once
    z = prepared.train.latents.float()
    energy = (z - prepared.prior.mean).square().sum((1, 2, 3)).mean()
    described = prepared.prior.marginal_variance().sum() + prepared.prior.rest_variance.sum()
    assert described.item() == pytest.approx(energy.item(), rel=0.15)
    assert prepared.prior.log_weight.shape == (2, 1)


def test_shapes_learn_what_the_person_shows(prepared_once):
    # the first beta of these people sets their density, so it can be read off them; the others are constant
    _, prepared = prepared_once
    held, prior = prepared.held, prepared.prior
    first = torch.searchsorted(held.geometry, torch.arange(len(held.betas)))
    features = prior.split(held.latents[first].float())[0] / prior.marginal_variance().sqrt()
    left = prepared.shapes.scale @ prepared.shapes.scale.T
    assert features.shape[1] == prepared.shapes.weight.shape[1]
    assert left[0, 0] < 0.8 * prepared.train.betas[:, 0].var()


def test_a_network_that_knows_more_has_less_error(prepared_once):
    from primdiffusion.diffusion.denoiser import DenoiserConfig, PersonDenoiser

    _, prepared = prepared_once
    denoiser = PersonDenoiser(DenoiserConfig(None, None), prepared.prior, linear())
    guesses = {
        "nothing": lambda x, t: prepared.prior.mean.expand_as(x),
        "gaussian": closed_form(denoiser, single=True),
        "truth": lambda x, t: prepared.held.latents.float(),
    }
    errors = x0_errors(guesses, denoiser.schedule, prepared.held.latents[:16], levels=(300, 900))
    for level in (300, 900):
        assert errors["gaussian"][level] < errors["nothing"][level]
    assert errors["gaussian"][300] < errors["gaussian"][900]


def test_log_uniform_levels_are_even_in_the_logarithm_of_noise_over_signal():
    schedule = fine_linear()
    t = random_steps(schedule, 20_000, torch.Generator().manual_seed(0), "log_uniform")
    ratio = (schedule.half_log_snr(0) - torch.tensor([schedule.half_log_snr(int(one)) for one in t])) / (
        schedule.half_log_snr(0) - schedule.half_log_snr(999)
    )
    assert torch.histc(ratio.float(), 8, 0, 1).min() > 0.1 * len(t)
    even = random_steps(schedule, 20_000, torch.Generator().manual_seed(0))
    assert (t < 50).float().mean() > 6 * (even < 50).float().mean()


def test_log_normal_levels_surround_the_spread_and_leave_no_level_untrained():
    schedule = fine_linear()
    t = random_steps(schedule, 20_000, torch.Generator().manual_seed(0), "log_normal", spread=0.05)
    clean, noise = schedule.levels(t, torch.empty(0, 1))
    ratio = (noise / clean).flatten().log()
    assert abs(float(ratio.median()) - math.log(2 * 0.05)) < 0.3
    assert ((ratio > math.log(0.01)) & (ratio < math.log(1.0))).float().mean() > 0.75
    assert (ratio > math.log(10.0)).float().mean() > 0.02


def test_person_components_live_in_the_leading_channels_alone(prepared_once):
    config, prepared = prepared_once
    z = prepared.train.latents[:8].float()
    prior = fit_prior(
        prepared.train, prepared.codec, prepared.vocabulary, dataclasses.replace(config.prior, channels=2)
    )
    assert prior.basis.shape[1] == 2 * GRID * GRID
    coefficients, rest = prior.split(z)
    assert torch.equal(rest[:, 2:], z[:, 2:] - prior.mean[2:])
    assert torch.allclose(prior.join(coefficients, rest), z, atol=1e-4)
    assert (prior.split(prior.join(coefficients, torch.zeros_like(rest)))[0] - coefficients).abs().max() < 1e-3


def test_blends_stay_within_a_geometry_and_keep_the_variance():
    geometry = torch.tensor([0, 0, 0, 1, 1, 2])
    weight, place = blends(geometry, 40_000, 1.0, torch.Generator().manual_seed(0))
    assert torch.equal(geometry[place[:, 0]], geometry[place[:, 1]])
    assert torch.allclose(weight.sum(1), torch.ones(40_000), atol=1e-6)
    assert weight.square().sum(1).mean().item() == pytest.approx(1.0, abs=0.02)
    alone, _ = blends(geometry, 100, 0.0, torch.Generator().manual_seed(0))
    assert torch.equal(alone[:, 1], torch.zeros(100))


def test_mixtures_are_weighted_sums_of_two():
    generator = torch.Generator().manual_seed(0)
    samples = torch.randn(5, 3, 4, generator=generator).half()
    weights = torch.tensor([[1.0, 0.0], [0.3, 0.7], [1.4, -0.4]])
    indices = torch.tensor([[0, 4], [1, 2], [3, 3]])
    expected = torch.einsum("bk,bkcd->bcd", weights, samples[indices].float())
    torch.testing.assert_close(mixed(samples, weights, indices), expected)


def test_error_weights_have_mean_one_at_every_level():
    error, std = torch.ones(2, 5), torch.rand(2, 5) + 0.1
    for power in (0.0, 1.0, 2.0):
        assert weighted_error(error, std, power).item() == pytest.approx(1.0, abs=1e-5)
    wide = torch.tensor([[1.0, 3.0]])
    assert weighted_error(torch.tensor([[0.0, 1.0]]), wide, 2.0).item() == pytest.approx(0.9, abs=1e-6)


@pytest.mark.parametrize("schedule", [linear(), sqrt_linear()])
def test_min_snr_weights_are_those_of_the_paper(schedule):
    # Hang et al. 2023, table 1: min(SNR, gamma) for a network that predicts x0
    config = PhaseConfig(steps=1, batch=1, weighting="min_snr", min_snr_gamma=5.0)
    signal, noise = schedule.levels(torch.tensor([0, 300, 999]), torch.zeros(3, 1))
    weight = level_weight(signal, noise, config)[:, 0]
    snr = schedule.alpha_bar / (1 - schedule.alpha_bar)
    assert weight.tolist() == pytest.approx([min(float(snr[t]), 5.0) for t in (0, 300, 999)], rel=1e-5)
    assert weight[0] == 5
    assert torch.equal(level_weight(signal, noise, PhaseConfig(steps=1, batch=1, weighting="plain")), torch.ones(3, 1))


def test_weightings_weight_what_they_say():
    error, std = torch.tensor([[1.0, 2.0], [3.0, 0.0]]), torch.tensor([[1.0, 2.0], [0.5, 1.0]])
    signal, noise = torch.tensor([[0.8], [0.1]]), torch.tensor([[0.6], [0.995]])
    losses = {
        name: objective(
            error, std, signal, noise, PhaseConfig(steps=1, batch=1, weighting=name, error_power=0.0)
        ).item()
        for name in ("whitened", "plain", "min_snr")
    }
    assert losses["whitened"] == pytest.approx((1 + 1 + 36 + 0) / 4)
    assert losses["plain"] == pytest.approx((1 + 4 + 9) / 4)
    assert losses["min_snr"] == pytest.approx(((0.8 / 0.6) ** 2 * 5 + (0.1 / 0.995) ** 2 * 9) / 4)


@pytest.mark.parametrize("name", ["person", "local"])
def test_every_weighting_trains_both_networks(prepared_once, name):
    config, prepared = prepared_once
    losses = []
    for weighting in ("whitened", "plain", "min_snr"):
        phases = {key: dataclasses.replace(getattr(config, key), weighting=weighting) for key in ("person", "local")}
        trainee = CellTrainee(dataclasses.replace(config, **phases), prepared, torch.device("cpu"))
        trainee.network(name).requires_grad_(True)
        loss = trainee.loss(name, torch.Generator().manual_seed(0))
        loss.backward()
        losses.append(loss.item())
        assert trainee.network(name).outer.weight.grad.abs().max() > 0
    assert len(set(losses)) == 3
    assert np.isfinite(losses).all()


def test_a_damaged_person_is_named(tmp_path, people):
    path = tmp_path / "person_000009.npz"
    path.write_bytes((people / "person_000000.npz").read_bytes()[:2000])
    with pytest.raises(ValueError, match="person_000009"):
        read_person(path)
    np.savez(path, voxels=np.zeros((1, 3), np.uint8), betas=np.zeros(10), attributes=np.array("{}"), full_density=100.0)
    with pytest.raises(ValueError, match="voxels"):
        read_person(path)


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="primdiffusion payloads"):
        find_people(tmp_path)


def test_blends_are_asked_for_by_what_both_people_have():
    condition = torch.tensor([[1.0, 0, 1, 0], [1.0, 0, 0, 1]])
    words = AttributeVocabulary({"sex": ("female", "male"), "pattern": ("patterned", "plain")}, {})
    people = LatentSet(torch.zeros(2, 1, 32, 32), torch.zeros(2, dtype=torch.int64), torch.zeros(1, 10), condition)
    indices, weights = torch.tensor([[0, 1], [0, 1]]), torch.tensor([[0.6, 0.4], [1.0, 0.0]])
    asked = [
        blend_conditions(people, indices, weights, words, 0.0, torch.Generator().manual_seed(s)) for s in range(200)
    ]
    most = torch.stack(asked).amax(0)
    assert torch.equal(most, torch.tensor([[1.0, 0, 0, 0], [1.0, 0, 1, 0]]))
